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
CLOSE_REPLAY_S: Final = 60.0  # writing a long log takes some seconds
LOOPBACK: Final = "127.0.0.1"


def watch(
    context: typer.Context,
    task: Annotated[str, typer.Argument(help="Name of the task, e.g. table-tennis.")],
    web: Annotated[bool, typer.Option("--web", help="Serve Rerun's viewer as a web page (the default).")] = False,
    native: Annotated[bool, typer.Option("--native", help="Open Rerun's viewer in a window.")] = False,
    terminal: Annotated[bool, typer.Option("--terminal", help="Show tables in this terminal; needs no Rerun.")] = False,
    replay: Annotated[
        str | None,
        typer.Option(metavar="DIR|URL", help="Show a run from a server's data directory or database; it may be off."),
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
        str,
        typer.Option(metavar="ADDRESS", help="Address to serve both on; other machines see it unless it is loopback."),
    ] = LOOPBACK,
    patience: Annotated[
        float, typer.Option(min=0.0, metavar="SECONDS", help="Longest wait for the server and the task.")
    ] = 60.0,
    connect: Connect = None,
    timeout: Timeout = 2.0,
    zenoh_config: ZenohConfig = None,
    log_level: LogLevel = "warning",
) -> None:
    """Watch a task learn, live: robots in 3D, learning curves, outcomes, workers.

    It only reads: it can be started and stopped at any time and changes nothing for the server and its workers. End it
    with Ctrl-C.

    With --replay it shows a run from its data directory, also while a server uses that: all but the poses, paths and
    durations that only workers publish. With --save and without --web or --native it then writes the file and ends.

    Example: crkr watch table-tennis --save run.rrd
    """
    if web + native + terminal > 1:
        raise typer.BadParameter("choose one of --web, --native and --terminal")
    served = {"--save": save, "--port": port, "--web-port": web_port, "--bind": None if bind == LOOPBACK else bind}
    if terminal and (idle := [option for option, value in served.items() if value is not None]):
        raise typer.BadParameter(f"--terminal records and serves nothing; leave out {', '.join(idle)}")
    configure_logging(log_level)
    target = None if save is None else _RecordingFile(save, overwrite=overwrite)
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
            complete = _in_rerun(session, _Addresses.choose(bind, port, web_port, stack), native, target)
    if not complete:
        where = "" if target is None else f"; the part that was written is in {target.growing}"
        _note(f"error: the recording could not be completed in time; its end may be missing{where}")
        os._exit(1)  # an ordinary exit waits for the same writer, without end


def _refuse_given(context: typer.Context, names: Sequence[str]) -> None:
    """Raise `typer.BadParameter` for options of a server that is not asked."""
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise typer.BadParameter(f"--replay asks no server; leave out --{name.replace('_', '-')}")


def _in_terminal(session: LiveSession | StoredSession) -> bool:
    from crkr.dashboard.terminal import TerminalDisplay

    with TerminalDisplay(stdout, session.task, replayed=session.replayed) as display:
        display.finish(session.show(display, TABLES_S))
    return True


def _in_file(session: LiveSession | StoredSession, target: _RecordingFile) -> bool:
    """Record a run to a file; returns whether the recording was completed in time."""
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording, failed = Recording(None, target.growing), True
    try:
        display = RerunDisplay(recording, session.task, replayed=session.replayed)
        display.finish(session.show(display, PICTURES_S))
        failed = False
    finally:
        complete = _close(recording, session, target, failed)
    return complete


def _in_rerun(
    session: LiveSession | StoredSession, addresses: _Addresses, native: bool, target: _RecordingFile | None
) -> bool:
    """Record a run to a file; returns whether the recording was completed in time."""
    from crkr.dashboard.rerun_view import Recording, RerunDisplay

    recording = Recording((addresses.bind, addresses.stream), None if target is None else target.growing)
    failed = True
    try:
        # Before any viewer: it sends the layout first.
        display = RerunDisplay(recording, session.task, replayed=session.replayed)
        with _viewer(addresses, native) as viewer:
            display.finish(session.show(display, PICTURES_S, lambda: viewer.is_running))
            if isinstance(session, StoredSession):
                _note("all of it is shown; Ctrl-C ends this")
                session.wait(lambda: viewer.is_running)
            if not (native or session.stop or viewer.is_running):
                raise Unavailable(f"the viewer's page is gone: {viewer.last_line()}")
        failed = False
    finally:
        complete = _close(recording, session, target, failed)
    return complete


def _close(
    recording: Recording, session: LiveSession | StoredSession, target: _RecordingFile | None, failed: bool
) -> bool:
    complete = recording.close(CLOSE_REPLAY_S if session.replayed and not session.stop else CLOSE_S)
    if target is None:
        return complete
    if not session.begun:
        target.remove()
    elif complete:
        _note(f"recording: {target.growing if failed else target.complete()}")
    return complete


@final
class _RecordingFile:
    """The file of --save. A new one is written under its name; a replacement beside the old one until it is complete.

    Attributes:
        growing: Path of the file while it is written.

    Raises:
        Invalid: As `check_output`.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        check_output(path, overwrite=overwrite)
        self._path = path
        self.growing: Final = beside(path) if path.exists() else path

    def complete(self) -> Path:
        """Give the complete recording its name, and return that."""
        if self.growing != self._path:
            self.growing.replace(self._path)
        return self._path

    def remove(self) -> None:
        """Remove a recording of nothing."""
        self.growing.unlink(missing_ok=True)


def _viewer(addresses: _Addresses, native: bool) -> Viewer:
    stream = stream_address(addresses.host, addresses.stream)
    if native:
        viewer = Viewer.native(stream, addresses.page)
        _note("viewer: opened in a window; close it to end this command")
        return viewer
    viewer = Viewer.web(addresses.bind, addresses.host, addresses.page, stream)
    _note(f"viewer: {page_address(addresses.host, addresses.page, addresses.stream)}")
    return viewer


@final
@dataclass(frozen=True, slots=True)
class _Addresses:
    """Addresses of the recording and the page.

    Attributes:
        bind: Address to listen on.
        host: The same address as a browser on this machine sees it.
        stream: Port of the recording.
        page: Port of the page, or of the window.
    """

    bind: str
    host: str
    stream: int
    page: int

    @classmethod
    def choose(cls, bind: str, port: int | None, web_port: int | None, claims: ExitStack) -> _Addresses:
        """Find ports; raises `Invalid` as `choose_port`, and `typer.BadParameter` for a bad address."""
        try:
            unspecified = ip_address(bind).is_unspecified
        except ValueError as error:
            raise typer.BadParameter(f"--bind needs an IP address; got {bind!r}") from error
        stream = _port(bind, port, STREAM_PORT, "the recording", claims)
        page = _port(bind, web_port, WEB_PORT, "the page", claims)
        return cls(bind, LOOPBACK if unspecified else bind, stream, page)


def _port(bind: str, given: int | None, default: int, purpose: str, claims: ExitStack) -> int:
    port = choose_port(bind, given, default, claims)
    if port != (given or default):
        _note(f"port {default} is taken; {purpose} is at {port}")
    return port


def _note(message: str) -> None:
    stderr.print(message)
