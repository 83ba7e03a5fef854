"""Limits of what waits for learning: of each task, and of all tasks together.

Over a common limit only tasks that hold more than their share are refused, so that a few slow tasks do not keep all
others out. Twice the common limit is refused to everybody, so that memory stays bounded.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, Final, final

from crkr.protocol import Busy
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.thread import Learning
from crkr.server.learning.waits import Waits
from crkr.server.queries.queue import busy
from crkr.server.queries.request import Job

__all__ = ["Limits"]

_MOST_TRIALS: Final = 20_000  # committed trials of a task that wait to be learned
_MOST_TRIALS_OF_ALL: Final = 100_000
_FEW_TRIALS: Final = 1000  # of a task, its least share
_MOST_ASKED: Final = 1024  # waiting steps of a task; a commit may exceed it
_MOST_ASKED_OF_ALL: Final = 4 * _MOST_ASKED
_FEW_ASKED: Final = 8
_MOST_BYTES: Final = 2**24  # of a task's requests that wait, if there are several
_MOST_BYTES_OF_ALL: Final = 4 * _MOST_BYTES
_FEW_BYTES: Final = 2**16


@final
class Limits:
    """Refuses what would wait for too long or hold too much, and counts what waits; any thread may."""

    def __init__(self, learning: Learning) -> None:
        self._learning = learning
        self._waits = Waits()
        self._held: Counter[str] = Counter()  # bytes of the requests that learning will answer, by task
        self._bytes = 0
        self._holding = threading.Lock()

    def refuse_trials(self, task: ServedTask) -> None:
        """Raise `Busy` if too many trials wait to be learned for the task to store more."""
        own, everyones = self._learning.waiting(task)[0], self._learning.backlog
        tasks = self._learning.waiting_tasks()[0] if everyones > _MOST_TRIALS_OF_ALL else 0
        if own > _MOST_TRIALS or _beyond_share(own, everyones, _MOST_TRIALS_OF_ALL, tasks, _FEW_TRIALS):
            raise Busy(f"{max(own, everyones)} trials wait to be learned from; ask again later", retry_ms=500)

    def refuse_waiting(self, request: Job, task: ServedTask) -> None:
        """Raise `Busy` if the request would wait for learning for too long, or too much waits already."""
        asked, everyones = self._learning.waiting(task)[1] + 1, self._learning.asked + 1
        tasks = self._learning.waiting_tasks()[1] if everyones > _MOST_ASKED_OF_ALL else 0
        many = asked > _MOST_ASKED or _beyond_share(asked, everyones, _MOST_ASKED_OF_ALL, tasks, _FEW_ASKED)
        slow = self._learning.is_behind(task) or self._waits.too_long(task.name)
        if slow or many or self._holds_too_much(request):
            raise busy(request.verb)

    def _holds_too_much(self, request: Job) -> bool:
        with self._holding:
            held = self._held.get(request.task, 0)
            own, everyones = held + request.size, self._bytes + request.size
            if held and own > _MOST_BYTES:
                return True
            return _beyond_share(own, everyones, _MOST_BYTES_OF_ALL, len(self._held), _FEW_BYTES)

    def hold(
        self, request: Job, task: ServedTask, done: Callable[[Any, Exception | None], None]
    ) -> Callable[[Any, Exception | None], None]:
        """Count a request that learning will answer, until the returned callback, which calls `done` once, runs."""

        def ended(result: Any, failure: Exception | None) -> None:
            self._add(request.task, -request.size)
            done(result, failure)

        left = [self._waits.timed(task.name, ended)]

        def once(result: Any, failure: Exception | None) -> None:
            timed = left.pop() if left else None
            if timed is not None:
                timed(result, failure)

        request.held = True
        self._add(request.task, request.size)
        return once

    def _add(self, task: str, size: int) -> None:
        with self._holding:
            self._bytes += size
            self._held[task] += size
            if not self._held[task]:
                del self._held[task]


def _beyond_share(own: int, everyones: int, most: int, tasks: int, few: int) -> bool:
    """Whether a common limit is reached, and a task's own part of it is large; tasks share half of it alike."""
    return everyones > most and (everyones > 2 * most or own > max(few, most // (2 * max(tasks, 1))))
