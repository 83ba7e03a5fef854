"""Notices a worker that hangs: it owes something and nothing is heard of it, though its process runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Hashable
from typing import Final, Generic, TypeVar, final

__all__ = ["StallWatch"]

Worker = TypeVar("Worker", bound=Hashable)

LONGEST_LOOK_S: Final = 2.0
STARTING: Final = 10.0  # a simulator that is loaded, perhaps with many others at once, takes longer than a trial


@final
class StallWatch(Generic[Worker]):
    """Measures how long each worker has been silent while it owed something.

    Only time counts in which somebody looked: when the watcher itself was held, as by Ctrl-Z, its workers were too.

    Args:
        limit_s: Silence that is no cause for concern [s]; ten times as long before a worker's first word.
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
        """Notes a sign of progress."""
        self._since.pop(worker, None)
        self._started.add(worker)

    def look(self, owing: Collection[Worker], waiting: Collection[Worker], grace_s: float) -> dict[Worker, float]:
        """Workers that hang, with how long they have been silent [s].

        Args:
            owing: All workers that owe something now.
            waiting: Those that said that they wait for something else.
            grace_s: How much longer these may be silent [s].
        """
        now = self._clock()
        self._watched_s += min(now - self._last_look, LONGEST_LOOK_S)
        self._last_look = now
        self._since = {worker: self._since.get(worker, self._watched_s) for worker in owing}
        silent = {worker: self._watched_s - since for worker, since in self._since.items()}
        return {
            worker: silence
            for worker, silence in silent.items()
            if silence > self._limit(worker) + (grace_s if worker in waiting else 0.0)
        }

    def _limit(self, worker: Worker) -> float:
        return self._limit_s if worker in self._started else STARTING * self._limit_s
