"""The web server of the live pages: one thread, many readers; a slow reader does not delay others."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any, Final, final

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from crkr.client import Client
from crkr.client.cli.stop_request import StopRequest
from crkr.dashboard.web.site import TIMEOUT_S, Site, application
from crkr.protocol import Invalid, Unavailable

__all__ = ["TIMEOUT_S", "bound", "parse_address", "serve", "shown"]

logger = logging.getLogger(__name__)

MOST: Final = 1024  # connections; more get 503
LONGEST_S: Final = 60.0  # of a connection
HEAD_BYTES: Final = 16_384
QUEUED: Final = 512
POLL_S: Final = 0.1
ENDS_S: Final = 3.0
NICE: Final = 5  # everything else on the machine goes first
LAST_PORT: Final = 65_535


def parse_address(given: str) -> tuple[str, int]:
    """Host and port of "[HOST:]PORT"; the host is loopback unless it is given. Raises `Invalid`."""
    host, _, port = given.rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > LAST_PORT:
        raise Invalid(f"an address is HOST:PORT, as in 127.0.0.1:8080; got {given!r}")
    return host.strip("[]") or "127.0.0.1", int(port)


def bound(host: str, port: int) -> socket.socket:
    """A listening socket; raises `Unavailable`, e.g. for a taken port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(QUEUED)
    except OSError as error:
        listening.close()
        raise Unavailable(f"cannot serve the page on {host}:{port}: {error.strerror or error}") from error
    return listening


def shown(listening: socket.socket) -> str:
    """The address of the site for a browser."""
    host, port = listening.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def serve(connect: Callable[[], Client], listening: socket.socket, stop: StopRequest, *, tied: bool = False) -> None:
    """Serve the pages of a server's tasks until stopped.

    Args:
        connect: Makes a client of that server.
        listening: Where browsers connect to.
        stop: When to end.
        tied: End with the process that holds the other end of standard input.

    Raises:
        Unavailable: The web server ended by itself.
    """
    os.nice(NICE)
    with closing(Site(connect)) as site:
        config = uvicorn.Config(
            application(site, _hosts(listening)),
            http=_BoundedProtocol,
            ws="none",
            lifespan="off",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=MOST,
            backlog=QUEUED,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=1,
            h11_max_incomplete_event_size=HEAD_BYTES,
        )
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listening],), name="web", daemon=True)
        thread.start()
        alone = threading.Event()
        if tied:
            threading.Thread(target=_wait_for_end, args=(alone,), name="parent", daemon=True).start()
        while thread.is_alive() and not (stop or alone.is_set()):
            time.sleep(POLL_S)
        ended = not (stop or alone.is_set())
        server.should_exit = True
        thread.join(ENDS_S)
    if ended:
        raise Unavailable("the web server ended; see its log")


def _wait_for_end(alone: threading.Event) -> None:
    try:
        while os.read(sys.stdin.fileno(), 1024):
            pass
    finally:
        alone.set()


def _hosts(listening: socket.socket) -> frozenset[str] | None:
    """Allowed host names: those of loopback if only this machine can connect, else any."""
    host = str(listening.getsockname()[0])
    return frozenset({"localhost", "127.0.0.1", "::1", host}) if ipaddress.ip_address(host).is_loopback else None


@final
class _BoundedProtocol(H11Protocol):
    """A connection with a time limit, so that silent and slow readers do not keep it forever."""

    def connection_made(self, transport: Any) -> None:
        """Begin; the end is set."""
        super().connection_made(transport)
        self._end = asyncio.get_running_loop().call_later(LONGEST_S, self._finish)

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._end.cancel()
        super().connection_lost(exc)

    def _finish(self) -> None:
        idle = self.cycle is None or self.cycle.response_complete
        if idle and not self.transport.get_write_buffer_size():
            self.transport.close()
        else:
            self.transport.abort()
