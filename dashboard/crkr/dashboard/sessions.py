"""Where a display gets a run from: a server that is followed until somebody stops it, or a data directory."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Protocol, final

from crkr.client import Client, Task
from crkr.client.cli.console import stderr
from crkr.client.cli.progress import ProgressBar
from crkr.dashboard.feed import Feed
from crkr.dashboard.progress import Progress
from crkr.dashboard.stored_run import StoredRun, open_run, replay
from crkr.dashboard.view import View
from crkr.dashboard.watch_loop import StopRequest, follow, wait_for_task
from crkr.protocol import CrkrError

__all__ = ["LiveSession", "ReplaySession", "Session"]

_logger = logging.getLogger(__name__)
LOOK_S: Final = 0.1  # between two looks at whether a shown replay was stopped


class Session(Protocol):
    """A run for a display."""

    @property
    def task(self) -> str:
        """The task's name."""
        ...

    @property
    def replayed(self) -> bool:
        """Whether it comes from a data directory, all at once."""
        ...

    @property
    def begun(self) -> bool:
        """Whether a view was told of the task."""
        ...

    @property
    def stop(self) -> StopRequest:
        """Whether somebody wants an end."""
        ...

    def show(self, view: View, tick_s: float, goes_on: Callable[[], bool] = lambda: True) -> Progress:
        """Tells the view of the run until that is over, stopped, or not `goes_on`."""
        ...


@final
class LiveSession:
    """A task at a server.

    Args:
        client: To ask with.
        task: The task's name.
        patience_s: How long to wait for server and task.
        stop: When to end.
        say: Told what is waited for.
    """

    replayed: Final = False

    def __init__(
        self, client: Client, task: str, patience_s: float, stop: StopRequest, say: Callable[[str], object]
    ) -> None:
        self.task: Final = task
        self.stop: Final = stop
        self.begun = False
        self._client = client
        self._patience_s = patience_s
        self._say = say

    def show(self, view: View, tick_s: float, goes_on: Callable[[], bool] = lambda: True) -> Progress:
        """Feeds the view until stopped."""
        feed = Feed(view)
        task = wait_for_task(self._client, self.task, self._patience_s, self.stop, self._say)
        if task is None:
            return feed.progress
        self.begun = True
        view.task(_description(task))
        follow(self._client, task, feed, tick_s, lambda: goes_on() and not self.stop)
        feed.finish()
        if feed.skipped:
            self._say(f"skipped {feed.skipped} publications or answers that could not be read or shown")
        return feed.progress


@final
class ReplaySession:
    """A task in a data directory; opened at once, so that what is wrong with it is said before anything is shown.

    Args:
        directory: The data directory.
        task: The task's name.
        stop: When to end.

    Raises:
        CrkrError: As `open_run`.
    """

    replayed: Final = True

    def __init__(self, directory: Path, task: str, stop: StopRequest) -> None:
        self.task: Final = task
        self.stop: Final = stop
        self.begun = False
        self._run: StoredRun = open_run(directory, task)

    def show(self, view: View, tick_s: float, goes_on: Callable[[], bool] = lambda: True) -> Progress:
        """Tells the view of every trial, with a progress bar."""
        del tick_s  # it is as quick as it can be
        with ProgressBar(stderr, f"replaying {self.task}", self._run.last, "log entries") as bar:
            self.begun = True
            view.task(self._run.spec.description)
            return replay(self._run, view, lambda: goes_on() and not self.stop, bar.show)

    def stay(self, goes_on: Callable[[], bool]) -> None:
        """Waits until stopped, or not `goes_on`: what was replayed is there to be looked at."""
        while goes_on() and not self.stop:
            time.sleep(LOOK_S)

    def close(self) -> None:
        """Lets go of the directory."""
        self._run.close()


def _description(task: Task) -> str:
    """What the task says of itself; a display can do without."""
    try:
        return task.spec.description
    except CrkrError as error:
        _logger.info("the task's description cannot be read: %s", error)
        return ""
