"""A static page of a task."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import Final

from crkr.client import Task
from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress as ProgressBar
from crkr.dashboard.page.document import document
from crkr.dashboard.page.markup import number
from crkr.dashboard.page.tables import stamp
from crkr.dashboard.page.view import PageView
from crkr.dashboard.progress import Progress
from crkr.dashboard.stored_session import open_run, replay

__all__ = ["read_stored", "read_task", "written"]

PAGE: Final = 1000  # trials in one answer


def read_task(task: Task) -> PageView:
    """Read every trial of a task that its server has stored by now.

    Raises:
        Unavailable: The server does not answer.
        UnknownTask: No such task.
    """
    progress = Progress(running=False)
    view, status = PageView(task.spec, progress), task.status()
    last = int(status.get("seq", 0))
    view.status(status, progress, time.monotonic())
    with (
        ThreadPoolExecutor(1) as asker,  # the server prepares a page while the one before is counted
        ProgressBar(stderr, f"reading {task.name}", last, "log entries") as bar,
    ):
        page = asker.submit(task.samples, 0, PAGE)
        following: int | None = 0
        while following is not None:
            trials, following = page.result()
            if following is not None and following < last:
                page = asker.submit(task.samples, following, PAGE)
            else:
                following = None
            view.trials([progress.add(stored, 0.0) for stored in trials], progress)
            bar.show(progress.seq)
    return view


def read_stored(data: str, task: str) -> PageView:
    """Read a task from a data directory, or from a database by its URL.

    Raises:
        CrkrError: As `open_run`.
    """
    with closing(open_run(data, task)) as run:
        progress = Progress(running=False)
        view = PageView(run.spec, progress)
        with ProgressBar(stderr, f"reading {task}", run.last, "log entries") as bar:
            replay(run, view, lambda: True, bar.show, progress)
    return view


def written(view: PageView) -> str:
    """The page as HTML."""
    figures = view.figures
    until = f"{number(figures.progress.trials)} training trials, log position {figures.progress.seq}"
    return document(figures.spec.name, view.parts(), f"{until}, as of {stamp(time.time())}.")
