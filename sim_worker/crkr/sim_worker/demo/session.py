"""One demo from start to summary."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

from crkr.client import Client
from crkr.sim_worker.demo.follower import CALL_S, Follower
from crkr.sim_worker.demo.learning_curve import draw_learning_curve
from crkr.sim_worker.demo.processes import Crew, DemoFailed
from crkr.sim_worker.demo.settings import DemoSettings
from crkr.sim_worker.supervisor.stop_request import StopRequest

__all__ = ["DemoResult", "run_demo"]

TICK_S: Final = 0.25


@final
@dataclass(frozen=True, slots=True)
class DemoResult:
    """How a demo went.

    Attributes:
        summary: Plain data, as `--json` prints it.
        status: Exit status.
        problem: Why it is not complete, or None.
        stopped_by: Name of the signal that ended it, or None.
        viewer: The viewer's address, or None.
    """

    summary: dict[str, Any]
    status: int
    problem: str | None
    stopped_by: str | None
    viewer: str | None


def run_demo(
    settings: DemoSettings,
    welcome: Sequence[str],
    say: Callable[[str], None],
    show: Callable[[int, str], None],
    finished: Callable[[DemoResult], None],
) -> DemoResult:
    """Runs a demo; when it returns or raises, none of its processes is left.

    Args:
        settings: What to run.
        welcome: Lines to say once the server answers.
        say: Prints a line for people.
        show: Shows the training trials stored and a remark, often.
        finished: Shows the result; server and viewer are still there, if they are to stay.

    Raises:
        DemoFailed: The data folder cannot be written, or the server did not start.
    """
    started = time.monotonic()
    _make_folder(settings)
    with ExitStack() as cleanup, StopRequest() as stop:
        crew = Crew(settings, say)
        cleanup.callback(lambda: crew.stop_rest(hurry=True))
        cleanup.callback(lambda: crew.stop_workers(hurry=True))
        client = cleanup.enter_context(Client(settings.endpoint, timeout_s=CALL_S))
        follower = Follower(client, settings.task)
        if crew.start_server(stop, client):
            for line in welcome:
                say(line)
            problem = _run(settings, crew, follower, stop, say, show)
        else:
            problem = None
        crew.stop_workers(hurry=bool(stop))
        follower.look(thoroughly=True)
        if not settings.stay or stop or problem:
            crew.stop_rest(hurry=bool(stop))
        result = _result(settings, crew, follower, stop, problem, started)
        finished(result)
        if settings.stay and not problem:
            _stay(stop)
    return result


def _make_folder(settings: DemoSettings) -> None:
    try:
        settings.logs.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "it is a file" if isinstance(error, NotADirectoryError | FileExistsError) else error.strerror
        raise DemoFailed(f"data folder {settings.data} cannot be written: {reason}; choose another --data") from error


def _stay(stop: StopRequest) -> None:
    """Waits for Enter, the end of standard input, or a signal."""
    while not stop and not select.select([sys.stdin], [], [], TICK_S)[0]:
        continue


def _run(
    settings: DemoSettings,
    crew: Crew,
    follower: Follower,
    stop: StopRequest,
    say: Callable[[str], None],
    show: Callable[[int, str], None],
) -> str | None:
    """Runs until the workers are done or a signal comes; what went wrong meanwhile is returned."""
    follower.begin()
    if follower.history is not None:
        say(f"resuming: {follower.history.trained} training trials are in {settings.data}")
        if (seed := follower.task.spec.seed) != settings.seed:
            say(f"task {settings.task} exists and keeps its seed {seed}, whatever --seed says")
    if settings.dashboard:
        crew.start_dashboard(stop)
    crew.start_workers()
    try:
        while crew.check() and not stop:
            follower.look()
            show(0 if follower.history is None else follower.history.trained, follower.remark())
            time.sleep(TICK_S)
    except DemoFailed as error:
        return error.message
    return None


def _result(
    settings: DemoSettings, crew: Crew, follower: Follower, stop: StopRequest, problem: str | None, started: float
) -> DemoResult:
    history = follower.history
    seed = settings.seed if history is None else follower.task.spec.seed  # a task that was there has its own
    drawn = history is not None and draw_learning_curve(
        history, f"{settings.task}, seed {seed}", follower.task.spec.budget, settings.figure
    )
    summary = {
        "task": settings.task,
        **follower.result(),
        "active": follower.active,
        "workers": settings.workers,
        "workers_lost": crew.workers_report().get("workers_lost", 0),
        "seed": seed,
        "resumed": follower.trained_before > 0,
        "stopped_by": None if stop.signal is None else stop.signal.name,
        "problem": problem,
        "wall_seconds": time.monotonic() - started,
        "data": str(settings.data),
        "recording": str(settings.recording) if _has_content(settings.recording) else None,
        "figure": str(settings.figure) if drawn else None,
        "logs": str(settings.logs),
    }
    return DemoResult(summary, 1 if problem else stop.status, problem, summary["stopped_by"], crew.viewer)


def _has_content(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0
