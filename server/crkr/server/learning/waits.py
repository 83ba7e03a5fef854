"""Estimates how long a request waits for its task to learn, from earlier requests.

Their number alone is not enough: a thousand reports are learned in a moment, a thousand changes of a long task in a
minute, longer than any client waits. Trials that nobody waits for are no requests: a task's `Line` counts those.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, final

__all__ = ["LONGEST_S", "Waits"]

LONGEST_S: Final = 2.0  # an ordinary call gives up after 5 s
_FEW: Final = 8  # requests that may always wait, or a task with long steps would accept none
_UNTRIED: Final = 64  # requests that may wait before the first answer
_WEIGHT: Final = 0.25  # weight of the newest time in the mean


@final
class _Wait:
    """The requests that wait for one task."""

    __slots__ = ("count", "each_s")

    def __init__(self) -> None:
        self.count = 0
        self.each_s: float | None = None


@final
class Waits:
    """Counts waiting requests by task, and measures how long they wait; any thread may."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._of: dict[str, _Wait] = {}

    def __len__(self) -> int:
        """Tasks for which a request waits."""
        return len(self._of)

    def too_long(self, task: str) -> bool:
        """Whether one more request would wait too long."""
        with self._lock:
            wait = self._of.get(task)
            if wait is None or wait.count < _FEW:
                return False
            return wait.count >= _UNTRIED if wait.each_s is None else wait.count * wait.each_s > LONGEST_S

    def timed(
        self, task: str, done: Callable[[Any, Exception | None], None]
    ) -> Callable[[Any, Exception | None], None]:
        """Count one more waiting request until the returned callback, which calls `done`, runs."""
        began = self._clock()
        with self._lock:
            wait = self._of.setdefault(task, _Wait())
            wait.count += 1
            place = wait.count

        def ended(result: Any, failure: Exception | None) -> None:
            each_s = (self._clock() - began) / place
            with self._lock:
                wait.count -= 1
                wait.each_s = each_s if wait.each_s is None else wait.each_s + _WEIGHT * (each_s - wait.each_s)
                if not wait.count:
                    del self._of[task]
            done(result, failure)

        return ended
