"""The loop behind `crkr watch`: waits for the task, then feeds a display until it is told to stop."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from crkr.client import Client, Task
from crkr.dashboard.feed import Feed
from crkr.dashboard.poller import Poller
from crkr.protocol import Unavailable, UnknownTask

__all__ = ["follow", "stopped_by_signals", "wait_for_task"]

ATTEMPT_S: Final = 1.0
MAX_BURST: Final = 200  # publications between two looks at the clock


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set; a second signal acts as usual."""
    stop = threading.Event()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        del number, frame  # either means the same
        stop.set()
        restore()

    for number in before:
        signal.signal(number, note)
    try:
        yield stop
    finally:
        restore()


def wait_for_task(
    client: Client, name: str, patience_s: float, stop: threading.Event, say: Callable[[str], object]
) -> Task | None:
    """The task once its server answers and has it; None when told to stop before.

    Raises:
        Unavailable: No server within the patience.
        UnknownTask: A server, but no such task within the patience.
    """
    task = client.task(name)
    deadline = time.monotonic() + patience_s
    said = False
    while not stop.is_set():
        try:
            task.status(timeout_s=ATTEMPT_S)
            return task
        except (Unavailable, UnknownTask) as error:
            missing = f"the server at {client.endpoint}" if isinstance(error, Unavailable) else f"task {name!r}"
            if not said:
                say(f"waiting up to {patience_s:.0f} s for {missing} ...")
                said = True
            if time.monotonic() > deadline:
                raise type(error)(f"{missing} did not appear within {patience_s:.0f} s: {error.message}") from error
            stop.wait(0.2)
    return None


def follow(client: Client, task: Task, feed: Feed, tick_s: float, goes_on: Callable[[], bool]) -> None:
    """Passes on news and publications, and lets the feed step every `tick_s`, while `goes_on`.

    At the end it closes the client if that does not answer.
    """
    with task.subscribe() as subscription, Poller(task, client.close) as poller:
        while goes_on():
            deadline = time.monotonic() + tick_s
            for _ in range(MAX_BURST):
                received = subscription.receive(max(0.0, deadline - time.monotonic()))
                if received is None:
                    break
                feed.publication(*received)
            for news in poller.take():
                feed.news(news, time.monotonic())
            feed.step(time.monotonic())
