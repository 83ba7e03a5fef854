"""Finds workers that hang: they have work, their process runs, and they report nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Hashable
from typing import Final, Generic, TypeVar, final

__all__ = ["StallWatch"]

Worker = TypeVar("Worker", bound=Hashable)

LONGEST_LOOK_S: Final = 2.0
STARTING: Final = 10.0  # loading a simulator takes longer than a trial


@final
class StallWatch(Generic[Worker]):
    """Measures how long each worker has been silent while it had work.

    Only time between two close calls counts, because Ctrl-Z suspends the supervisor together with its workers.

    Args:
        limit_s: Longest silence of a healthy worker [s]; ten times as long before its first event.
        clock: Monotonic time [s].
    """

    def __init__(self, limit_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._limit_s = limit_s
        self._clock = clock
        self._last_look = clock()
        self._watched_s = 0.0
        self._since: dict[Worker, float] = {}
        self._started: set[Worker] = set()

    def heard(self, worker: Worker) -> None:
        """Notes a worker's progress."""
        self._since.pop(worker, None)
        self._started.add(worker)

    def look(self, busy: Collection[Worker], waiting: Collection[Worker], grace_s: float) -> dict[Worker, float]:
        """Workers that hang, with how long they have been silent [s].

        Args:
            busy: All workers that have work now.
            waiting: Those that reported that they wait for the server.
            grace_s: How much longer these may be silent [s].
        """
        now = self._clock()
        self._watched_s += min(now - self._last_look, LONGEST_LOOK_S)
        self._last_look = now
        self._since = {worker: self._since.get(worker, self._watched_s) for worker in busy}
        silent = {worker: self._watched_s - since for worker, since in self._since.items()}
        return {
            worker: silence
            for worker, silence in silent.items()
            if silence > self._limit(worker) + (grace_s if worker in waiting else 0.0)
        }

    def _limit(self, worker: Worker) -> float:
        return self._limit_s if worker in self._started else STARTING * self._limit_s
