"""The server: a socket of this machine, and what runs on it until Ctrl-C."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import socket
from collections.abc import Callable
from types import FrameType

import uvicorn
from starlette.types import ASGIApp

from wlplan.errors import InputError, one_line
from wlplan.serve.desk import Desk

# Requests at once, and how long those at hand may take once it ends [s].
_MOST_AT_ONCE, _PATIENCE = 64, 10


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


class _Server(uvicorn.Server):
    """Has the work at hand stop as soon as it is to end."""

    desk: Desk
    say: Callable[[str], None]

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Ctrl-C or SIGTERM; the second time it does not wait."""
        if self.desk.pending() and not self.should_exit:
            self.say("stopping what is computed; Ctrl-C again does not wait for it")
        self.desk.stop_all()
        super().handle_exit(sig, frame)


def run(app: ASGIApp, taken: socket.socket, desk: Desk, say: Callable[[str], None]) -> None:
    """Serves until Ctrl-C or SIGTERM.

    Args:
        app: The application.
        taken: Of `bound`.
        desk: Is closed at the end.
        say: Told what is worth knowing at the end.
    """
    # What it would log is in our lines, or in the answers.
    logging.getLogger("uvicorn").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        app,
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        access_log=False,
        server_header=False,
        limit_concurrency=_MOST_AT_ONCE,
        timeout_graceful_shutdown=_PATIENCE,
    )
    server = _Server(config)
    server.desk, server.say = desk, say
    try:
        # It ends by sending itself what ended it.
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[taken])
    finally:
        desk.close(0.0 if server.force_exit else _PATIENCE)
