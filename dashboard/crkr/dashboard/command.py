"""`crkr watch`."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Final, final

import typer

from crkr.client import Client, Task
from crkr.client.console import configure_logging, stderr, stdout
from crkr.client.options import Connect, LogLevel, Timeout, ZenohConfig
from crkr.dashboard.feed import Feed
from crkr.dashboard.ports import choose_port
from crkr.dashboard.view import View
from crkr.dashboard.viewer import Viewer, page_address, require_display, stream_address
from crkr.dashboard.watching import StopRequest, follow, wait_for_task
from crkr.protocol import CrkrError, Unavailable

__all__ = ["watch"]

_logger = logging.getLogger(__name__)
STREAM_PORT: Final = 9876
WEB_PORT: Final = 9090
PICTURES_S: Final = 1 / 15
TABLES_S: Final = 0.25
CLOSE_S: Final = 1.5
LOOPBACK: Final = "127.0.0.1"


def watch(
    task: Annotated[str, typer.Argument(help="Name of the task, e.g. table-tennis.")],
    web: Annotated[bool, typer.Option("--web", help="Serve Rerun's viewer as a web page (the default).")] = False,
    native: Annotated[bool, typer.Option("--native", help="Open Rerun's viewer in a window.")] = False,
    terminal: Annotated[bool, typer.Option("--terminal", help="Show tables in this terminal; needs no Rerun.")] = False,
    save: Annotated[Path | None, typer.Option(metavar="RUN.rrd", help="Also write the recording to this file.")] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the recording; 9876 or the next free one.")
    ] = None,
    web_port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the web page; 9090 or the next free one.")
    ] = None,
    bind: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Address to serve both on; another than loopback shows it to others.")
    ] = LOOPBACK,
    patience: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="How long to wait for the server and the task.")
    ] = 60.0,
    connect: Connect = None,
    timeout: Timeout = 2.0,
    zenoh_config: ZenohConfig = None,
    log_level: LogLevel = "warning",
) -> None:
    """Watch a task learn, live: robots in 3D, learning curves, outcomes, workers.

    It only looks: starting, stopping or losing it changes nothing for the server and its workers, and it can be started
    at any time. End it with Ctrl-C.

    Example: crkr watch table-tennis --save run.rrd
    """
    if web + native + terminal > 1:
        raise typer.BadParameter("choose one of --web, --native and --terminal")
    served = {"--save": save, "--port": port, "--web-port": web_port, "--bind": None if bind == LOOPBACK else bind}
    if terminal and (idle := [option for option, value in served.items() if value is not None]):
        raise typer.BadParameter(f"--terminal records and serves nothing; leave out {', '.join(idle)}")
    configure_logging(log_level)
    with StopRequest() as stop, Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        session = _Session(client, task, patience, stop)
        if terminal:
            complete = _in_terminal(session)
        else:
            if native:
                require_display()
            if save is not None:
                save.open("ab").close()  # says at once where it cannot be written
            complete = _in_rerun(session, _Places.choose(bind, port, web_port), native, save)
    if not complete:
        _note("error: the recording could not be completed in time; its end may be missing")
        os._exit(1)  # an ordinary exit would wait for the same writer without end


@final
class _Session:
    """What every display needs: the task to come, and when to stop."""

    def __init__(self, client: Client, task: str, patience_s: float, stop: StopRequest) -> None:
        self.client = client
        self.task = task
        self.patience_s = patience_s
        self.stop = stop

    def show(self, view: View, tick_s: float, goes_on: Callable[[], bool] = lambda: True) -> Feed:
        """Feeds the view until stopped."""
        feed = Feed(view)
        task = wait_for_task(self.client, self.task, self.patience_s, self.stop, _note)
        if task is None:
            return feed
        view.task(_description(task))
        follow(self.client, task, feed, tick_s, lambda: goes_on() and not self.stop)
        feed.finish()
        return feed


def _description(task: Task) -> str:
    """What the task says of itself; a display can do without."""
    try:
        return task.spec.description
    except CrkrError as error:
        _logger.info("the task's description cannot be read: %s", error)
        return ""


def _in_terminal(session: _Session) -> bool:
    from crkr.dashboard.terminal import TerminalDisplay

    with TerminalDisplay(stdout, session.task) as display:
        display.finish(session.show(display, TABLES_S).progress)
    return True


def _in_rerun(session: _Session, places: _Places, native: bool, save: Path | None) -> bool:
    """Returns whether the recording was completed in time."""
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording = Recording((places.bind, places.stream), save)
    try:
        display = RerunDisplay(recording, session.task)  # before any viewer: it sends the layout first
        with _viewer(places, native) as viewer:
            feed = session.show(display, PICTURES_S, lambda: viewer.is_running)
            display.finish(feed.progress)
            if not (native or session.stop or viewer.is_running):
                raise Unavailable(f"the viewer's page is gone: {viewer.complaint()}")
    finally:
        complete = recording.close(CLOSE_S)
        if save is not None and complete:
            _note(f"recording: {save}")
    return complete


def _viewer(places: _Places, native: bool) -> Viewer:
    stream = stream_address(places.host, places.stream)
    if native:
        viewer = Viewer.native(stream, places.page)
        _note("viewer: a window of its own; closing it ends this")
        return viewer
    viewer = Viewer.web(places.bind, places.host, places.page, stream)
    _note(f"viewer: {page_address(places.host, places.page, places.stream)}")
    return viewer


@final
@dataclass(frozen=True, slots=True)
class _Places:
    """Where recording and page are served.

    Attributes:
        bind: Address to listen on.
        host: How a browser on this machine calls it.
        stream: Port of the recording.
        page: Port of the page; with a window, the one that the window insists on.
    """

    bind: str
    host: str
    stream: int
    page: int

    @classmethod
    def choose(cls, bind: str, port: int | None, web_port: int | None) -> _Places:
        """Finds free ports; raises `Invalid` for a given one that is taken, `typer.BadParameter` for no address."""
        try:
            unspecified = ip_address(bind).is_unspecified
        except ValueError as error:
            raise typer.BadParameter(f"--bind needs an IP address; got {bind!r}") from error
        stream = _port(bind, port, STREAM_PORT, "the recording")
        page = _port(bind, web_port, WEB_PORT, "the page")
        return cls(bind, LOOPBACK if unspecified else bind, stream, page)


def _port(bind: str, given: int | None, default: int, purpose: str) -> int:
    port = choose_port(bind, given, default)
    if port != (given or default):
        _note(f"port {default} is taken; {purpose} is at {port}")
    return port


def _note(message: str) -> None:
    stderr.print(message)
