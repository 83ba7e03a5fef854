"""The loop behind `crkr watch`: waits for the task, then feeds a display until it is told to stop."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Final, final

from crkr.client import Client, Task
from crkr.dashboard.feed import Feed
from crkr.dashboard.poller import Poller
from crkr.protocol import Unavailable, UnknownTask

__all__ = ["StopRequest", "follow", "wait_for_task"]

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last when a terminal is closed
PAUSE_S: Final = 0.2
MAX_BURST: Final = 200  # publications between two looks at the clock


@final
class StopRequest:
    """Becomes true at the first SIGINT, SIGTERM or SIGHUP while entered; main thread only. `nohup` keeps its meaning.

    A plain flag: the handler runs on the main thread, and an event's lock may just then be held by that very thread.
    From then on a further signal ends the process at once, whatever it is doing; a further SIGHUP does not, since shell
    and kernel both send one when a terminal is closed.
    """

    def __init__(self) -> None:
        self._told = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        self._before = {number: signal.signal(number, self._note) for number in _heeded()}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __bool__(self) -> bool:
        return self._told

    def _note(self, number: int, frame: FrameType | None) -> None:
        del number, frame  # each signal means the same
        # The system's own action, not KeyboardInterrupt: that would wait for a call into a library to return.
        for each in self._before:
            signal.signal(each, signal.SIG_IGN if each is signal.SIGHUP else signal.SIG_DFL)
        self._told = True


def _heeded() -> list[signal.Signals]:
    """The signals, without SIGHUP where whoever started this process had it ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in SIGNALS if number is not signal.SIGHUP or not ignored]


def wait_for_task(
    client: Client, name: str, patience_s: float, stop: StopRequest, say: Callable[[str], object]
) -> Task | None:
    """The task once its server answers and has it; None when told to stop before.

    Args:
        client: Its deadline is that of each question, and so the longest that a stop takes.
        name: The task.
        patience_s: When to give up [s].
        stop: Whether to stop; looked at after each question.
        say: Told once that there is something to wait for.

    Raises:
        Unavailable: No server within the patience.
        UnknownTask: A server, but no such task within the patience.
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


def follow(client: Client, task: Task, feed: Feed, tick_s: float, goes_on: Callable[[], bool]) -> None:
    """Passes on news and publications, and lets the feed step every `tick_s`, while `goes_on`.

    At the end it closes the client if that does not answer.
    """
    with task.subscribe() as subscription, Poller(task, client.close) as poller:
        while goes_on():
            deadline = time.monotonic() + tick_s
            for _ in range(MAX_BURST):
                if not feed.take(subscription, max(0.0, deadline - time.monotonic())):
                    break
            for news in poller.take():
                feed.news(news, time.monotonic())
            feed.step(time.monotonic())
            if subscription.closed and goes_on():
                raise Unavailable("the subscription to the workers' publications has ended; start watch again")
