"""A display of a run that is over, or goes on elsewhere, from the data directory alone: no server is asked.

What reads the directory is found by entry point, so that the dashboard knows no database. The run's own clock, by which
its trials were stored, stands in for the time that passes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final, Protocol

from crkr.dashboard.progress import Progress
from crkr.dashboard.view import NOT_STORED, View
from crkr.protocol import StoredTrial, TaskSpec, Unsupported

__all__ = ["StoredRun", "open_run", "replay"]

GROUP: Final = "crkr.data_directories"
"""Entry points of what reads data directories; `stored-run` is called with a directory and a task's name."""

SMALLEST_PAGE: Final = 25
PAGES: Final = 1000  # of a long log: more points of the learner's curves, and more tables, than anybody can tell apart


class StoredRun(Protocol):
    """One task of a data directory."""

    @property
    def spec(self) -> TaskSpec:
        """The specification in force."""
        ...

    @property
    def last(self) -> int:
        """Log position of the last entry."""
        ...

    def pages(self, size: int) -> Iterator[tuple[list[StoredTrial], Mapping[str, Any]]]:
        """All trials in the order of seq, each page with the server's `status` after it, as far as the log tells."""
        ...

    def close(self) -> None:
        """Lets go of the directory."""
        ...


def open_run(directory: Path, task: str) -> StoredRun:
    """Opens a data directory for reading.

    Raises:
        Unsupported: Nothing that is installed reads data directories.
        StorageError: There is no log, or it is damaged.
        UnknownTask: No such task.
    """
    found = list(entry_points(group=GROUP, name="stored-run"))
    if not found:
        raise Unsupported("nothing that is installed reads data directories: pip install 'crkr[server]'")
    run: StoredRun = found[0].load()(directory, task)
    return run


def replay(run: StoredRun, view: View, goes_on: Callable[[], bool], done: Callable[[int], None]) -> Progress:
    """Tells a view of every stored trial, while `goes_on`; returns the run as far as it was told.

    Args:
        run: What was stored.
        view: What to tell.
        goes_on: Asked before each page.
        done: Told of every log position reached.

    Raises:
        StorageError: The log is damaged.
    """
    progress, now = Progress(), 0.0
    for trials, status in run.pages(max(SMALLEST_PAGE, run.last // PAGES)):
        if not goes_on():
            break
        now = max(now, *(stored.time for stored in trials))  # a clock may have been set back
        view.trials([progress.add(stored, now) for stored in trials], progress)
        for result in progress.followed_epochs():
            view.epoch(result, progress)
        view.status(status, progress, now)
        view.tick(now, progress)
        done(progress.seq)
    for result in progress.finished_epochs(math.inf):
        view.epoch(result, progress)
    view.say(NOT_STORED)
    return progress
