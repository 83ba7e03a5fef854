"""`crkr server`: runs the service until it is stopped."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import select
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer

if TYPE_CHECKING:
    from crkr.server.learning.served_task import ServedTask
    from crkr.server.log import TaskLog
    from crkr.server.membership import Membership
    from crkr.server.metrics.endpoint import MetricsEndpoint
    from crkr.server.server import ServerSettings
    from crkr.server.stderr_log import StderrLog
    from crkr.server.web_process import WebProcess

__all__ = ["server"]

logger = logging.getLogger(__name__)

_SWITCH_S: Final = 0.0001  # a prediction waits this long for a thread that computes in Python
_ARENAS: Final = (-8, 2)  # M_ARENA_MAX of glibc: with an arena for each thread, freed memory stays spread over all
_GARBAGE: Final = 10_000  # new objects between collections; almost nothing here is cyclic
_LAST_PORT: Final = 65535
_SEEN: Final = "CRKR_SEEN_POSITIONS"  # log positions that this process saw before its restart
_EXIT_PATIENCE_S: Final = 1.9  # then the process exits: everything acknowledged is committed


def server(
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT", help="Zenoh endpoint, tcp/127.0.0.1:7447 unless a configuration file says otherwise."
        ),
    ] = None,
    data: Annotated[
        str, typer.Option(metavar="DIR|URL", help="Data directory, created if missing, or postgresql://...")
    ] = "crkr-data",
    zenoh_config: Annotated[Path | None, typer.Option(help="Zenoh configuration file (JSON5).")] = None,
    peer: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Share the tasks of --data postgresql://... with the server there."),
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Serve Prometheus metrics by HTTP, on loopback unless told."),
    ] = None,
    web: Annotated[
        str | None,
        typer.Option(metavar="[HOST:]PORT", help="Serve live web pages of all tasks, on loopback unless told."),
    ] = None,
    web_zenoh_config: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            metavar="FILE",
            help="A client's Zenoh configuration for the web pages, where clients need certificates or passwords.",
        ),
    ] = None,
    log_level: Annotated[str, typer.Option(envvar="CRKR_LOG_LEVEL", help="debug, info, warning or error.")] = "info",
) -> None:
    """Run the policy service. Ctrl-C ends it; the same command continues with the stored data.

    Example: crkr server --listen tcp/127.0.0.1:7447 --data crkr-data --web 8080
    """
    from crkr.protocol import ShuttingDown, printable
    from crkr.server.log.postgres.url import is_url, printable_location
    from crkr.server.server import Server, ServerSettings
    from crkr.server.session import endpoints
    from crkr.server.thread_faults import FAULTS, check_threads

    if peer and not is_url(data):
        raise typer.BadParameter("servers share the tasks of a database only", param_hint="--peer")
    check_threads()
    log = _log_to_stderr(log_level)
    FAULTS.watch()
    _be_quick()
    told_to_stop, serving = _stop_signal(), threading.Event()
    threading.Thread(target=_leave_before, args=(told_to_stop, serving, log), name="early end", daemon=True).start()
    with ExitStack() as stack:
        stack.callback(log.flush)
        endpoint = stack.enter_context(closing(_metrics_endpoint(metrics))) if metrics else None
        pages = stack.enter_context(closing(_web_process(web))) if web else None
        settings = ServerSettings(data, listen, zenoh_config, peer or ())
        where = ", ".join(endpoints(listen, zenoh_config))
        about = f"crkr server {version('crkr')}"

        def say(what: str) -> None:
            log.add(printable(f"{about} {what}"))

        replaced, lost = socket.socketpair()
        opened, tasks, membership = _open(settings, where, say, lost)
        leave: Callable[[], Any] = partial(_begin_anew, membership)
        try:
            with closing(Server(settings, opened, tasks, membership)) as running:
                told = f"listening on {where}, data in {printable_location(data)}, {len(running.tasks.all())} tasks"
                if endpoint is not None:
                    endpoint.show(running.sources)
                    told += f", metrics at http://{endpoint.address}/metrics"
                if pages is not None:
                    pages.start(endpoints(listen, zenoh_config)[0], web_zenoh_config)
                    told += f", pages at http://{pages.address}/"
                say(told)
                serving.set()
                ready, _, _ = select.select([told_to_stop, replaced], [], [])
                if told_to_stop in ready:
                    leave = partial(os._exit, 0)
                watchdog = threading.Timer(_EXIT_PATIENCE_S, leave)
                watchdog.daemon = True
                watchdog.start()
        except ShuttingDown as error:
            logger.warning("this server stands by again: %s", error.message)
    # All is closed. The interpreter's own exit is skipped: it aborts if a thread is just returning from Zenoh.
    leave()


def _begin_anew(membership: Membership | None) -> NoReturn:
    """Restart the process under the same id: a Zenoh session that closes under load leaves threads behind."""
    if membership is not None:
        os.environ[_SEEN] = str(membership.positions())
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _open(
    settings: ServerSettings, listen: str, say: Callable[[str], None], lost: socket.socket
) -> tuple[TaskLog, list[ServedTask], Membership | None]:
    """The log and its tasks. Waits for a shared log; `lost` is called once if its tasks are lost."""
    from crkr.server.log.postgres.url import is_url

    if not is_url(settings.data):
        from crkr.server.learning.restore import open_directory

        return *open_directory(Path(settings.data)), None
    from crkr.server.follower import Follower
    from crkr.server.membership import Membership

    seen = int(os.environ.get(_SEEN, "0"))
    follower = Follower(settings.data, listen, say, settings.peers, settings.zenoh_config, seen)
    opened, tasks = follower.take()

    def tell(why: str) -> None:
        logger.warning("this server leaves the log: %s", why)
        lost.send(b"\0")

    return opened, tasks, Membership(opened, tell)


def _metrics_endpoint(given: str) -> MetricsEndpoint:
    from crkr.server.metrics.endpoint import MetricsEndpoint

    return MetricsEndpoint(*_address(given, "--metrics", 9464))


def _web_process(given: str) -> WebProcess:
    from crkr.server.web_process import WebProcess

    return WebProcess(*_address(given, "--web", 8080))


def _address(given: str, option: str, usual: int) -> tuple[str, int]:
    host, _, port = given.rpartition(":")
    if not port.isascii() or not port.isdigit() or int(port) > _LAST_PORT:
        raise typer.BadParameter(f"an address is HOST:PORT, as in 127.0.0.1:{usual}; got {given!r}", param_hint=option)
    return host.strip("[]") or "127.0.0.1", int(port)


def _stop_signal() -> socket.socket:
    """A socket that receives a byte at SIGTERM, Ctrl-C, or the terminal's hang-up unless `nohup` ignores that.

    A handler must not set an event: it runs on the main thread, which deadlocks on the event's lock inside `wait`.
    """
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    hang_up = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
    for number in (signal.SIGTERM, signal.SIGINT, *hang_up):
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    return reader


def _leave_before(told_to_stop: socket.socket, serving: threading.Event, log: StderrLog) -> None:
    """End the process if the signal comes before it serves; restoring a long log may take a minute."""
    told_to_stop.recv(1, socket.MSG_PEEK)
    if not serving.is_set():
        log.flush()
        os._exit(0)


def _be_quick() -> None:
    """Tune the interpreter for short waits rather than throughput."""
    sys.setswitchinterval(_SWITCH_S)
    if "MALLOC_ARENA_MAX" not in os.environ:
        with suppress(AttributeError):  # another library than glibc
            ctypes.CDLL(None).mallopt(*_ARENAS)
    gc.collect()
    gc.freeze()  # modules imported so far stay, so collections can skip them
    gc.set_threshold(_GARBAGE, 20, 100)


def _log_to_stderr(level: str) -> StderrLog:
    from crkr.server.stderr_log import StderrLog

    number = logging.getLevelName(level.upper())
    if not isinstance(number, int):
        raise typer.BadParameter(f"no level {level!r}; choose debug, info, warning or error", param_hint="--log-level")
    return StderrLog(number)
