"""One demo from start to summary."""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from crkr.client import Client
from crkr.client.cli.stop_request import StopRequest
from crkr.sim_worker.demo.learning_curve import draw_learning_curve
from crkr.sim_worker.demo.log_follower import CALL_S, LogFollower
from crkr.sim_worker.demo.processes import DemoFailed, DemoProcesses
from crkr.sim_worker.demo.settings import DemoSettings
from crkr.sim_worker.demo.summary import DemoResult

__all__ = ["run_demo"]

TICK_S: Final = 0.25


def run_demo(
    settings: DemoSettings,
    welcome: Sequence[str],
    say: Callable[[str], None],
    show: Callable[[int, str], None],
    finished: Callable[[DemoResult], None],
) -> DemoResult:
    """Runs a demo; none of its processes outlives the call.

    Args:
        settings: What to run.
        welcome: Lines to say once the server answers.
        say: Prints a line for people.
        show: Shows the training trials stored and a remark, often.
        finished: Shows the result, before server and viewer end where they are to stay.

    Raises:
        DemoFailed: The data folder cannot be written, or the server did not start.
    """
    started = time.monotonic()
    _make_folder(settings)
    with ExitStack() as cleanup, StopRequest() as stop:
        processes = DemoProcesses(settings, say)
        cleanup.callback(lambda: processes.stop_rest(hurry=True))
        cleanup.callback(lambda: processes.stop_workers(hurry=True))
        client = cleanup.enter_context(Client(settings.endpoint, timeout_s=CALL_S))
        follower = LogFollower(client, settings.task)
        if processes.start_server(stop, client):
            for line in welcome:
                say(line)
            problem = _run(settings, processes, follower, stop, say, show)
        else:
            problem = None
        processes.stop_workers(hurry=bool(stop))
        follower.update(thoroughly=True)
        if not settings.stay or stop or problem:
            processes.stop_rest(hurry=bool(stop))
        result = _result(settings, processes, follower, stop, problem, started)
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
    processes: DemoProcesses,
    follower: LogFollower,
    stop: StopRequest,
    say: Callable[[str], None],
    show: Callable[[int, str], None],
) -> str | None:
    """Runs until the workers are done or a signal comes; returns what went wrong, or None."""
    follower.begin()
    if follower.history is not None:
        say(f"resuming: {follower.history.trained} training trials are in {settings.data}")
        if (seed := follower.task.spec.seed) != settings.seed:
            say(f"task {settings.task} exists and keeps its seed {seed}, whatever --seed says")
    if settings.dashboard:
        processes.start_dashboard(stop)
    processes.start_workers()
    try:
        while processes.check() and not stop:
            follower.update()
            show(0 if follower.history is None else follower.history.trained, follower.remark())
            time.sleep(TICK_S)
    except DemoFailed as error:
        return error.message
    return None


def _result(
    settings: DemoSettings,
    processes: DemoProcesses,
    follower: LogFollower,
    stop: StopRequest,
    problem: str | None,
    started: float,
) -> DemoResult:
    history = follower.history
    seed = settings.seed if history is None else follower.task.spec.seed  # an existing task has its own
    drawn = history is not None and draw_learning_curve(
        history, f"{settings.task}, seed {seed}", follower.task.spec.budget, settings.figure
    )
    summary = {
        "task": settings.task,
        **follower.result(),
        "active": follower.active,
        "workers": settings.workers,
        "workers_lost": processes.workers_report().get("workers_lost", 0),
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
    return DemoResult(summary, 1 if problem else stop.status, problem, summary["stopped_by"], processes.viewer)


def _has_content(path: Path) -> bool:
    return path.exists() and path.stat().st_size > 0
