"""A task in a data directory, shown on a display without a server.

An entry point names the reader of the directory, so that the dashboard knows no database. The times at which trials
were stored replace the clock.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from typing import Any, Final, Protocol, final

from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress as ProgressBar
from crkr.client.cli.stop_request import StopRequest
from crkr.dashboard.feed import NOT_STORED, View
from crkr.dashboard.progress import Progress
from crkr.protocol import StoredTrial, TaskSpec, Unsupported

__all__ = ["StoredRun", "StoredSession", "open_run", "replay"]

GROUP: Final = "crkr.data_directories"
"""Group of entry points; `stored-run` is called with a data directory, or a database's URL, and a task's name."""

SMALLEST_PAGE: Final = 25
LOOK_S: Final = 0.1  # between two looks at whether a shown run was stopped
PAGES: Final = 1000  # pages of a long log: more points than a screen shows


class StoredRun(Protocol):
    """One task of a data directory."""

    @property
    def spec(self) -> TaskSpec:
        """The specification in force."""

    @property
    def last(self) -> int:
        """Log position of the last entry."""

    def pages(self, size: int) -> Iterator[tuple[list[StoredTrial], Mapping[str, Any]]]:
        """All trials in the order of seq; each page with the `status` after it, as far as the log has it."""

    def close(self) -> None:
        """Close the directory."""


def open_run(data: str, task: str) -> StoredRun:
    """Open a data directory, or a database by its URL, for reading.

    Raises:
        Unsupported: No installed package reads data directories.
        StorageError: The directory has no log, or a damaged one.
        UnknownTask: No such task.
    """
    found = list(entry_points(group=GROUP, name="stored-run"))
    if not found:
        raise Unsupported("nothing that is installed reads data directories: pip install 'crkr[server]'")
    run: StoredRun = found[0].load()(data, task)
    return run


def replay(
    run: StoredRun,
    view: View,
    goes_on: Callable[[], bool],
    done: Callable[[int], None],
    progress: Progress | None = None,
) -> Progress:
    """Show every stored trial on a view, while `goes_on`; returns the run as far as it was shown.

    Args:
        run: The stored run.
        view: The display.
        goes_on: Called before each page.
        done: Called with the log position after each page.
        progress: What counts the run; a new one unless given.

    Raises:
        StorageError: The log is damaged.
    """
    progress, now = progress or Progress(), 0.0
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


@final
class StoredSession:
    """A task in a data directory, which is opened at once: an error comes before anything is shown.

    Raises:
        CrkrError: As `open_run`.
    """

    replayed: Final = True

    def __init__(self, data: str, task: str, stop: StopRequest) -> None:
        self.task: Final = task
        self.stop: Final = stop
        self.begun = False
        self._run = open_run(data, task)

    def show(self, view: View, tick_s: float, goes_on: Callable[[], bool] = lambda: True) -> Progress:
        """Show every trial on the view, with a progress bar."""
        del tick_s  # Unused.
        with ProgressBar(stderr, f"replaying {self.task}", self._run.last, "log entries") as bar:
            self.begun = True
            view.task(self._run.spec.description)
            return replay(self._run, view, lambda: goes_on() and not self.stop, bar.show)

    def wait(self, goes_on: Callable[[], bool]) -> None:
        """Wait until stopped, or not `goes_on`, while the user looks at the run."""
        while goes_on() and not self.stop:
            time.sleep(LOOK_S)

    def close(self) -> None:
        """Close the directory."""
        self._run.close()
