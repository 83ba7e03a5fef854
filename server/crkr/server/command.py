"""`crkr server`: runs the service until it is told to stop."""

from __future__ import annotations

import gc
import logging
import os
import signal
import socket
import sys
import threading
from contextlib import ExitStack, closing
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

if TYPE_CHECKING:
    from crkr.server.metrics.endpoint import MetricsEndpoint
    from crkr.server.stderr_log import StderrLog

__all__ = ["server"]

logger = logging.getLogger(__name__)

_SWITCH_S: Final = 0.0001  # a prediction waits about this long for a thread that computes in Python
_GARBAGE: Final = 10_000  # new objects between collections; almost nothing here is cyclic
_LAST_PORT: Final = 65535
_EXIT_PATIENCE_S: Final = 1.9  # then the process leaves as it is: everything acknowledged is committed anyway


def server(
    listen: Annotated[
        str | None, typer.Option(help="Zenoh endpoint, tcp/127.0.0.1:7447 unless a configuration file says otherwise.")
    ] = None,
    data: Annotated[Path, typer.Option(help="Data directory, made where there is none.")] = Path("crkr-data"),
    zenoh_config: Annotated[Path | None, typer.Option(help="Zenoh configuration file (JSON5).")] = None,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Serve Prometheus metrics by HTTP, on loopback unless told."),
    ] = None,
    log_level: Annotated[str, typer.Option(envvar="CRKR_LOG_LEVEL", help="debug, info, warning or error.")] = "info",
) -> None:
    """Run the policy service: `crkr server --listen tcp/127.0.0.1:7447 --data crkr-data --metrics 9464`."""
    from crkr.protocol import printable
    from crkr.server.server import Server, ServerSettings
    from crkr.server.session import endpoints
    from crkr.server.thread_faults import FAULTS

    log = _log_to_stderr(log_level)
    FAULTS.watch()
    _be_quick()
    told_to_stop, serving = _stop_signal(), threading.Event()
    threading.Thread(target=_leave_before, args=(told_to_stop, serving, log), name="early end", daemon=True).start()
    with ExitStack() as stack:
        stack.callback(log.flush)
        endpoint = stack.enter_context(closing(_metrics_endpoint(metrics))) if metrics else None
        running = stack.enter_context(closing(Server(ServerSettings(data, listen, zenoh_config))))
        where = ", ".join(endpoints(listen, zenoh_config))
        told = f"listening on {where}, data in {data}, {len(running.tasks.all())} tasks"
        if endpoint is not None:
            endpoint.show(running.sources)
            told += f", metrics at http://{endpoint.address}/metrics"
        log.add(printable(f"crkr server {version('crkr')} {told}"))
        serving.set()
        told_to_stop.recv(1)
        watchdog = threading.Timer(_EXIT_PATIENCE_S, os._exit, (0,))
        watchdog.daemon = True
        watchdog.start()
    # All is closed. The interpreter's own exit is skipped: it aborts if a thread is just returning from Zenoh.
    os._exit(0)


def _metrics_endpoint(given: str) -> MetricsEndpoint:
    from crkr.server.metrics.endpoint import MetricsEndpoint

    host, _, port = given.rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > _LAST_PORT:
        raise typer.BadParameter(
            f"an address is HOST:PORT, as in 127.0.0.1:9464; got {given!r}", param_hint="--metrics"
        )
    return MetricsEndpoint(host.strip("[]") or "127.0.0.1", int(port))


def _stop_signal() -> socket.socket:
    """A socket that receives a byte at SIGTERM, Ctrl-C, or the terminal's hang-up unless `nohup` ignores that.

    An event set by a handler would not do: the handler runs on the main thread, which deadlocks on the event's own lock
    if it is just inside `wait`.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    hang_up = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    for number in (signal.SIGTERM, signal.SIGINT, *hang_up):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    return reader


def _leave_before(told_to_stop: socket.socket, serving: threading.Event, log: StderrLog) -> None:
    """End the process if the signal comes before it serves: a long log may take a minute, and nothing is lost."""
    told_to_stop.recv(1, socket.MSG_PEEK)
    if not serving.is_set():
        log.flush()
        os._exit(0)


def _be_quick() -> None:
    """Tune the interpreter for short waits rather than throughput."""
    sys.setswitchinterval(_SWITCH_S)
    gc.collect()
    gc.freeze()  # what is imported by now stays: no collection need look at it again
    gc.set_threshold(_GARBAGE, 20, 100)


def _log_to_stderr(level: str) -> StderrLog:
    from crkr.server.stderr_log import StderrLog

    number = logging.getLevelName(level.upper())
    if not isinstance(number, int):
        raise typer.BadParameter(f"{level!r} is none of debug, info, warning, error", param_hint="--log-level")
    return StderrLog(number)
