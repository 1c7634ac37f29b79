"""What stands before all endpoints: plain ASGI, each one function around an application.

A server that listens on this machine alone can still be reached by any page that a browser here
shows. So a name that somebody had point here is refused, and so is what another page sends.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from wlplan.serve.answers import Refused, refusal

# Bytes beyond the limit that are read and dropped, so that whoever sends them hears why.
_DROPPED = 64 * 2**20
_LONGEST_LINE = 300

_HEADERS = {
    # Scripts and styles are files of ours; nothing comes from, or goes to, anywhere else.
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def logged(app: ASGIApp, write: Callable[[str], None]) -> ASGIApp:
    """A line for each request: method, path, status, bytes sent, milliseconds."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        begin, status, size = time.perf_counter(), 0, 0

        async def counted(message: Message) -> None:
            nonlocal status, size
            if message["type"] == "http.response.start":
                status = message["status"]
            size += len(message.get("body", b""))
            await send(message)

        try:
            await app(scope, receive, counted)
        finally:
            spent = 1000.0 * (time.perf_counter() - begin)
            write(f"{scope['method']} {shown_path(scope)} {status} {size} B {spent:.0f} ms")

    return guarded


def shown_path(scope: Scope) -> str:
    """Path and query as they came, without anything that a terminal would obey."""
    raw = scope.get("raw_path") or scope["path"].encode()
    raw += b"?" + scope["query_string"] if scope.get("query_string") else b""
    text = "".join(chr(b) if 0x20 < b < 0x7F else f"\\x{b:02x}" for b in raw)
    return text if len(text) <= _LONGEST_LINE else f"{text[:_LONGEST_LINE]}..."


def with_headers(app: ASGIApp) -> ASGIApp:
    """What tells a browser to be careful, unless an answer says it itself."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        async def told(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await app(scope, receive, told)

    return guarded


def at_home(app: ASGIApp, names: tuple[str, ...]) -> ASGIApp:
    """Refuses requests that a page of somebody else may have had a browser make.

    Args:
        app: What is guarded.
        names: Names that this machine may be called by; addresses need none. A page that is to
            reach us under a name of its own has to have the browser send that name.
    """

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (why := _stranger(scope, names)):
            await refusal(Refused(403, why))(scope, receive, send)
            return
        await app(scope, receive, send)

    return guarded


def _stranger(scope: Scope, names: tuple[str, ...]) -> str:
    """Why a request is refused; nothing if it is not."""
    headers = Headers(scope=scope)
    host = headers.get("host", "")
    name = _host_name(host)
    if not (name in names or _is_address(name)):
        return "this host name is not ours: use the address that `wlplan serve` printed."
    if scope["method"] in ("GET", "HEAD"):
        return ""
    origin, site = headers.get("origin"), headers.get("sec-fetch-site", "same-origin")
    if origin is not None and origin != f"{scope['scheme']}://{host}":
        return "this comes from another page: send it from the one of this server."
    return "" if site in ("same-origin", "none") else "this comes from another page."


def _host_name(host: str) -> str:
    """The name in a Host header, without its port."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def sized(app: ASGIApp, most: int) -> ASGIApp:
    """Refuses bodies of more bytes."""
    said = f"the request is larger than {most / 2**20:g} MiB: send less, or start with --most-mb."

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await app(scope, receive, send)
            return
        length = Headers(scope=scope).get("content-length", "0")
        if not length.isdecimal() or int(length) > most:
            await _drop(receive)
            await refusal(Refused(413, said))(scope, receive, send)
            return
        taken = 0

        async def measured() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > most:
                await _drop(receive)
                raise Refused(413, said)
            return message

        await app(scope, measured, send)

    return guarded


async def _drop(receive: Receive) -> None:
    """Reads on, up to a limit."""
    dropped = 0
    while dropped < _DROPPED:
        message = await receive()
        dropped += len(message.get("body", b""))
        if message["type"] != "http.request" or not message.get("more_body"):
            return
