"""`crkr watch`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, final

import typer

from crkr.client import Client
from crkr.client.cli.console import configure_logging, stderr, stdout
from crkr.client.cli.options import Connect, LogLevel, Overwrite, Timeout, ZenohConfig
from crkr.client.cli.output_file import beside, check_output
from crkr.client.cli.stop_request import StopRequest
from crkr.dashboard.live_session import LiveSession
from crkr.dashboard.stored_session import StoredSession
from crkr.dashboard.viewer import Viewer, choose_port, page_address, require_display, stream_address
from crkr.protocol import Unavailable

if TYPE_CHECKING:
    from crkr.dashboard.rerun_view import Recording

__all__ = ["watch"]

STREAM_PORT: Final = 9876
WEB_PORT: Final = 9090
PICTURES_S: Final = 1 / 15
TABLES_S: Final = 0.25
CLOSE_S: Final = 1.5
CLOSE_REPLAY_S: Final = 60.0  # a long log is written for some seconds, and nobody waits to be let go
LOOPBACK: Final = "127.0.0.1"


def watch(
    context: typer.Context,
    task: Annotated[str, typer.Argument(help="Name of the task, e.g. table-tennis.")],
    web: Annotated[bool, typer.Option("--web", help="Serve Rerun's viewer as a web page (the default).")] = False,
    native: Annotated[bool, typer.Option("--native", help="Open Rerun's viewer in a window.")] = False,
    terminal: Annotated[bool, typer.Option("--terminal", help="Show tables in this terminal; needs no Rerun.")] = False,
    replay: Annotated[
        Path | None,
        typer.Option(metavar="DATA-DIR", help="Show what a server's data directory holds; no server is needed."),
    ] = None,
    save: Annotated[Path | None, typer.Option(metavar="RUN.rrd", help="Also write the recording to this file.")] = None,
    overwrite: Overwrite = False,
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

    With --replay it shows a run from its data directory, beside a server that uses it if need be: all but what only
    workers publish, poses and paths above all. With --save and no --web or --native it then writes the file and ends.

    Example: crkr watch table-tennis --save run.rrd
    """
    if web + native + terminal > 1:
        raise typer.BadParameter("choose one of --web, --native and --terminal")
    served = {"--save": save, "--port": port, "--web-port": web_port, "--bind": None if bind == LOOPBACK else bind}
    if terminal and (idle := [option for option, value in served.items() if value is not None]):
        raise typer.BadParameter(f"--terminal records and serves nothing; leave out {', '.join(idle)}")
    configure_logging(log_level)
    target = None if save is None else _Target(save, overwrite=overwrite)
    with ExitStack() as stack:
        stop = stack.enter_context(StopRequest(second_ends=True))
        session: LiveSession | StoredSession
        if replay is None:
            client = stack.enter_context(Client(connect, timeout_s=timeout, zenoh_config=zenoh_config))
            session = LiveSession(client, task, patience, stop, _note)
        else:
            _refuse_given(context, ("connect", "timeout", "zenoh_config", "patience"))
            session = stack.enter_context(closing(StoredSession(replay, task, stop)))
        if native:
            require_display()
        if terminal:
            complete = _in_terminal(session)
        elif session.replayed and target is not None and not (web or native):
            complete = _in_file(session, target)
        else:
            complete = _in_rerun(session, _Places.choose(bind, port, web_port), native, target)
    if not complete:
        where = "" if target is None else f"; what there is of it is in {target.place}"
        _note(f"error: the recording could not be completed in time; its end may be missing{where}")
        os._exit(1)  # an ordinary exit would wait for the same writer without end


def _refuse_given(context: typer.Context, names: Sequence[str]) -> None:
    """Raises `typer.BadParameter` for options of a server where none is asked."""
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--replay asks no server; leave out --{name.replace('_', '-')}")


def _in_terminal(session: LiveSession | StoredSession) -> bool:
    from crkr.dashboard.terminal import TerminalDisplay

    with TerminalDisplay(stdout, session.task, replayed=session.replayed) as display:
        display.finish(session.show(display, TABLES_S))
    return True


def _in_file(session: LiveSession | StoredSession, target: _Target) -> bool:
    """Returns whether the recording was completed in time."""
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording, failed = Recording(None, target.place), True
    try:
        display = RerunDisplay(recording, session.task, replayed=session.replayed)
        display.finish(session.show(display, PICTURES_S))
        failed = False
    finally:
        complete = _close(recording, session, target, failed)
    return complete


def _in_rerun(session: LiveSession | StoredSession, places: _Places, native: bool, target: _Target | None) -> bool:
    """Returns whether the recording was completed in time."""
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording = Recording((places.bind, places.stream), None if target is None else target.place)
    failed = True
    try:
        # Before any viewer: it sends the layout first.
        display = RerunDisplay(recording, session.task, replayed=session.replayed)
        with _viewer(places, native) as viewer:
            display.finish(session.show(display, PICTURES_S, lambda: viewer.is_running))
            if isinstance(session, StoredSession):
                _note("all of it is shown; Ctrl-C ends this")
                session.stay(lambda: viewer.is_running)
            if not (native or session.stop or viewer.is_running):
                raise Unavailable(f"the viewer's page is gone: {viewer.complaint()}")
        failed = False
    finally:
        complete = _close(recording, session, target, failed)
    return complete


def _close(recording: Recording, session: LiveSession | StoredSession, target: _Target | None, failed: bool) -> bool:
    complete = recording.close(CLOSE_REPLAY_S if session.replayed and not session.stop else CLOSE_S)
    if target is None:
        return complete
    if not session.begun:
        target.drop()
    elif complete:
        _note(f"recording: {target.place if failed else target.settle()}")
    return complete


@final
class _Target:
    """The file of --save: a new one grows under its name, and one in place of another beside that until it is complete.

    Attributes:
        place: Where it grows.

    Raises:
        Invalid: As `check_output`.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        check_output(path, overwrite=overwrite)
        self._path = path
        self.place: Final = beside(path) if path.exists() else path

    def settle(self) -> Path:
        """Gives the complete recording its name."""
        if self.place != self._path:
            self.place.replace(self._path)
        return self._path

    def drop(self) -> None:
        """Removes a recording of nothing."""
        self.place.unlink(missing_ok=True)


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
