"""How long those will wait who ask to be answered when their task has learned: as long as those before them, each.

A number of waiting requests alone says little: a thousand reports are learned in a moment, a thousand changes of a long
task in a minute, and nobody waits that long for an answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, final

__all__ = ["Waits"]

_LONGEST_S: Final = 2.0  # that one more may have to wait; an ordinary call gives up after 5 s
_FEW: Final = 8  # that may wait in any case, or a task with long steps would take no change at all
_UNTRIED: Final = 64  # that may wait before the first of them was answered
_WEIGHT: Final = 0.25  # of the newest, in the mean


@final
class _Wait:
    """Those who wait for one task."""

    __slots__ = ("count", "each_s")

    def __init__(self) -> None:
        self.count = 0
        self.each_s: float | None = None


@final
class Waits:
    """Counts who waits for which task, and measures how long; any thread may."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of: dict[str, _Wait] = {}

    def too_long(self, task: str) -> bool:
        """Whether one more would wait too long for its answer."""
        with self._lock:
            wait = self._of.get(task)
            if wait is None or wait.count < _FEW:
                return False
            return wait.count >= _UNTRIED if wait.each_s is None else wait.count * wait.each_s > _LONGEST_S

    def timed(
        self, task: str, done: Callable[[Any, Exception | None], None]
    ) -> Callable[[Any, Exception | None], None]:
        """`done`, which is called once, for one more who waits from now on until then."""
        began = time.monotonic()
        with self._lock:
            wait = self._of.setdefault(task, _Wait())
            wait.count += 1
            place = wait.count

        def ended(result: Any, failure: Exception | None) -> None:
            each_s = (time.monotonic() - began) / place
            with self._lock:
                wait.count -= 1
                wait.each_s = each_s if wait.each_s is None else wait.each_s + _WEIGHT * (each_s - wait.each_s)
                if not wait.count:
                    del self._of[task]
            done(result, failure)

        return ended
