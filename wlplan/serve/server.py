"""The server: a socket of this machine, and what runs on it until Ctrl-C."""

from __future__ import annotations

import ipaddress
import logging
import signal
import socket
from collections.abc import Callable
from types import FrameType

import uvicorn
from starlette.types import ASGIApp

from wlplan.errors import InputError, one_line
from wlplan.serve.desk import Desk

# Requests at once, and signals after which nothing is waited for.
_MOST_AT_ONCE, _ENOUGH = 64, 2


def is_loopback(host: str) -> bool:
    """Whether a host is this machine as it sees itself, and nobody else does."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bound(host: str, port: int) -> socket.socket:
    """A socket that is ours from now on, and listens once it is served.

    Args:
        host: Name or address.
        port: 0 for any that is free.

    Raises:
        InputError: If it cannot be had.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        taken = socket.socket(family, kind, protocol)
    except OSError as error:
        raise InputError(f"{host}: is no host of this machine ({one_line(error)}).") from error
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        taken.bind(address)
    except OSError as error:
        taken.close()
        raise InputError(
            f"port {port} of {host} cannot be had ({one_line(error.strerror or error)}): end what "
            f"uses it, or choose another --port."
        ) from error
    return taken


class Server(uvicorn.Server):
    """A server that can be told what to do as it begins and as it is to end.

    Attributes:
        beginning: Called once it listens.
        ending: Called by Ctrl-C and SIGTERM; the second time nothing is waited for.
    """

    beginning: Callable[[], None] | None = None
    ending: Callable[[], None] | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """What uvicorn does to listen."""
        await super().startup(sockets)
        if self.beginning is not None and self.started:
            self.beginning()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """What uvicorn calls then."""
        if self.ending is not None:
            self.ending()
        super().handle_exit(sig, frame)


def made(app: ASGIApp) -> Server:
    """A server of an application, which runs once its `run([socket])` is called."""
    # What it would log is in our lines, or in the answers.
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
    return Server(
        uvicorn.Config(
            app,
            http="h11",
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            limit_concurrency=_MOST_AT_ONCE,
        )
    )


def run(
    app: ASGIApp,
    taken: socket.socket,
    desk: Desk,
    *,
    beginning: Callable[[], None],
    note: Callable[[str], None],
) -> bool:
    """Serves until Ctrl-C or SIGTERM, in the main thread.

    Args:
        app: The application.
        taken: Of `bound`.
        desk: Is closed at the end.
        beginning: Called once it listens.
        note: Told what is worth knowing at the end.

    Returns:
        Whether nothing is computed any more, see `Desk.close`.
    """
    server = made(app)

    def ending() -> None:
        if desk.pending() and not server.should_exit:
            note("stopping what is computed; Ctrl-C again does not wait for it")
        desk.stop_all()

    server.beginning, server.ending = beginning, ending
    # It ends by sending itself what ended it. Our handlers only count: an exception from them could
    # come anywhere, and SIGTERM is to end us no harder than Ctrl-C.
    signals: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda sig, frame: signals.append(sig))
    server.run(sockets=[taken])
    ended = desk.close(lambda: len(signals) < _ENOUGH)
    # As Python goes down it forgets handlers, and one more would kill it: nothing is left to end.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    return ended
