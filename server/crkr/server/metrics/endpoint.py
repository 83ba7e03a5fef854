"""The HTTP endpoint that Prometheus scrapes."""

from __future__ import annotations

import errno
import logging
import socket
import socketserver
import sys
import threading
from contextlib import suppress
from typing import Any, Final, final

from prometheus_client import CollectorRegistry, MetricsHandler, ProcessCollector, disable_created_metrics

from crkr.protocol import Unavailable
from crkr.server.metrics.collector import MetricsCollector, MetricSources
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["MetricsEndpoint"]

logger = logging.getLogger(__name__)

_PATIENCE_S: Final = 5.0  # for a silent scraper
_MOST: Final = 16  # connections at once; a further one replaces the oldest
_PAUSE_S: Final = 0.1  # pause when the process has no file descriptor left
_POLL_S: Final = 0.05  # the longest delay of its end


@final
class MetricsEndpoint:
    """Listens from the beginning; serves the process's metrics, and a server's after `show`.

    A context manager, which ends it.

    Attributes:
        address: Host and port that it listens on.

    Raises:
        Unavailable: The address cannot be listened on, e.g. the port is taken.
    """

    def __init__(self, host: str, port: int, *, patience_s: float = _PATIENCE_S) -> None:
        disable_created_metrics()  # type: ignore[no-untyped-call]  # else each comes with the time of its first value
        self._registry = CollectorRegistry()
        ProcessCollector(registry=self._registry)
        handler = MetricsHandler.factory(self._registry)
        handler.timeout = patience_s  # type: ignore[attr-defined]  # every request handler has one
        try:
            self._http = (_Http6 if ":" in host else _Http)((host, port), handler)
        except OSError as error:
            taken = "the port is in use; stop what listens there or choose another"
            reason = taken if error.errno == errno.EADDRINUSE else error.strerror or str(error)
            raise Unavailable(f"cannot serve metrics on {_shown(host, port)}: {reason}") from error
        self.address: Final = _shown(host, self._http.server_address[1])
        self._shown: MetricsCollector | None = None
        self._thread = threading.Thread(target=keep_running, args=(self._serve,), name="metrics", daemon=True)
        self._thread.start()

    def show(self, sources: MetricSources) -> None:
        """Answer with a server's metrics too, from now on; with those of one server at a time."""
        if self._shown is not None:
            self._registry.unregister(self._shown)
        self._shown = MetricsCollector(sources)
        self._registry.register(self._shown)

    def _serve(self) -> bool:
        self._http.serve_forever(_POLL_S)
        return False

    def close(self) -> None:
        """Stop listening."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join(_PATIENCE_S)


class _Http(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 4 * _MOST

    def __init__(self, address: tuple[str, int], handler: Any) -> None:
        self._open: dict[socket.socket, None] = {}  # the oldest first
        self._changing = threading.Lock()
        self._closing = threading.Event()
        super().__init__(address, handler)

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError:  # the waiting client is still there, so the next attempt would fail at once
            self._closing.wait(_PAUSE_S)
            raise

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._changing:
            oldest = next(iter(self._open)) if len(self._open) >= _MOST else None
            if oldest is not None:
                del self._open[oldest]
            self._open[request] = None
        if oldest is not None:
            with suppress(OSError):  # it ended by itself
                oldest.shutdown(socket.SHUT_RDWR)
        try:
            super().process_request(request, client_address)
        except RuntimeError as error:  # no more threads can be started, which the metrics tell
            FAULTS.note(error, "metrics")
            self.process_request_thread(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        except BaseException as error:
            FAULTS.note(error, "metrics")

    def shutdown_request(self, request: Any) -> None:
        with self._changing:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def server_close(self) -> None:
        self._closing.set()
        super().server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        del request
        error = sys.exception()
        if not isinstance(error, ConnectionError | TimeoutError):  # otherwise the scraper has just left
            logger.error("metrics could not be given to %s", client_address, exc_info=error)


@final
class _Http6(_Http):
    address_family = socket.AF_INET6


def _shown(host: str, port: object) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
