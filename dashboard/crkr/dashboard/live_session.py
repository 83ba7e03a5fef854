"""A task at a server, shown on a display until the user stops it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final, final

from crkr.client import Client, Task
from crkr.client.cli.stop_request import StopRequest
from crkr.dashboard.feed import Feed, View
from crkr.dashboard.poller import Poller
from crkr.dashboard.progress import Progress
from crkr.protocol import CrkrError, Unavailable, UnknownTask

__all__ = ["LiveSession", "follow", "wait_for_task"]

_logger = logging.getLogger(__name__)
PAUSE_S: Final = 0.2
MAX_BURST: Final = 200  # publications between two looks at the clock


@final
class LiveSession:
    """A task at a server."""

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
        """Feed the view until stopped."""
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


def _description(task: Task) -> str:
    """The task's description; "" if it cannot be read."""
    try:
        return task.spec.description
    except CrkrError as error:
        _logger.info("the task's description cannot be read: %s", error)
        return ""


def wait_for_task(
    client: Client, name: str, patience_s: float, stop: StopRequest, say: Callable[[str], object]
) -> Task | None:
    """Wait for a server that answers and has the task; None if stopped before.

    Args:
        client: Its timeout is that of each question, and so bounds the time to stop.
        name: The task.
        patience_s: Longest wait [s].
        stop: Checked after each question.
        say: Called once with the reason for waiting.

    Raises:
        Unavailable: No server answered in time.
        UnknownTask: A server answered, but has no such task in time.
    """
    task = client.task(name)
    deadline = time.monotonic() + patience_s
    said = False
    while not stop:
        try:
            task.status()
            return task
        except (Unavailable, UnknownTask) as error:
            missing = f"the server at {client.endpoint}" if isinstance(error, Unavailable) else f"task {name!r}"
            if not said:
                say(f"waiting up to {patience_s:.0f} s for {missing} ...")
                said = True
            if time.monotonic() > deadline:
                advice = "start one: crkr server" if isinstance(error, Unavailable) else error.message
                waited = f"{missing} did not appear within {patience_s:.0f} s"
                raise type(error)(f"{waited}; {advice}", details=error.details) from error
            time.sleep(PAUSE_S)
    return None


def follow(
    client: Client, task: Task, feed: Feed, tick_s: float, goes_on: Callable[[], bool], *, rest: float = 0.0
) -> None:
    """Feed a display from the log and the publications, with a step every `tick_s` [s], while `goes_on`.

    Starts at the feed's position. If a question is open at the end, the client is closed. `rest` is as for `Poller`.
    """
    poller = Poller(task, client.close, after=feed.progress.seq, rest=rest)
    with task.subscribe() as subscription, poller:
        while goes_on():
            deadline = time.monotonic() + tick_s
            for _ in range(MAX_BURST):
                if not feed.take(subscription, max(0.0, deadline - time.monotonic())):
                    break
            for update in poller.take():
                feed.update(update, time.monotonic())
            feed.step(time.monotonic())
            if subscription.closed and goes_on():
                raise Unavailable("the subscription to the workers' publications has ended; start watch again")
