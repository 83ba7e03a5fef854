"""A bounded queue a verb and one thread that works it off: one lane's load never waits in another's queue."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, Final, Generic, TypeVar, final

from crkr.protocol import Busy, CrkrError, ShuttingDown
from crkr.server.request import Job

__all__ = ["Lane", "busy", "shutting_down"]

logger = logging.getLogger(__name__)

_RETRY_MS: Final = 50
_MOST_BYTES: Final = 64 * 2**20  # that may wait in a lane
_BATCH_BYTES: Final = 2 * 2**20  # after which a batch is not made longer
_Job = TypeVar("_Job", bound=Job)


def shutting_down() -> ShuttingDown:
    """What is answered between the order to stop and the end."""
    return ShuttingDown("the server is shutting down; ask its successor", retry_ms=200)


@final
class Lane(Generic[_Job]):
    """Works off requests in the order they came, several at once where the work can use that.

    Args:
        name: Of the thread.
        limits: verb -> how many may wait; one more is refused with `Busy`.
        work: Answers a batch; what it leaves unanswered by raising is answered by the lane.
        most: Largest batch. Batches are what is waiting; nothing waits for a batch to fill.
        rests: While more waits, the lane rests after each batch for as long as that took: who asks without end leaves
            half of a core, and Python's lock for half of the time, to those who ask for little.
    """

    def __init__(
        self,
        name: str,
        limits: Mapping[str, int],
        work: Callable[[list[_Job]], None],
        most: int = 1,
        *,
        rests: bool = False,
    ) -> None:
        self._limits, self._work, self._most, self._rests = dict(limits), work, most, rests
        self._queue: deque[_Job] = deque()
        self._waiting: Counter[str] = Counter()
        self._bytes = 0
        self._lock = threading.Lock()
        # A lock that is let go of wakes the thread in one step, half the time that a condition takes to.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._asleep = self._closing = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begins to work."""
        self._thread.start()

    def offer(self, request: _Job) -> CrkrError | None:
        """Queues a request, or says why not; then the caller answers it."""
        limit = self._limits[request.verb]
        with self._lock:
            full = self._waiting[request.verb] >= limit or (self._queue and self._bytes + request.size > _MOST_BYTES)
            if full or self._closing:
                return busy(request.verb) if full else shutting_down()
            self._waiting[request.verb] += 1
            self._bytes += request.size
            self._queue.append(request)
            ring, self._asleep = self._asleep, False
        if ring:
            self._bell.release()
        return None

    def depths(self) -> dict[str, Any]:
        """Verb -> how many wait and how many may."""
        return {verb: {"waiting": self._waiting[verb], "limit": limit} for verb, limit in self._limits.items()}

    def close(self, patience_s: float) -> None:
        """Takes nothing more, works off the rest for `patience_s`, then refuses what is left."""
        self._ending.set()
        with self._lock:
            self._closing = True
            ring, self._asleep = self._asleep, False
        if ring:
            self._bell.release()
        if self._thread.is_alive():
            self._thread.join(patience_s)
        with self._lock:
            left = list(self._queue)
            self._queue.clear()
        for request in left:
            request.fail(shutting_down())

    def _run(self) -> None:
        while batch := self._take():
            began = time.monotonic()
            try:
                self._work(batch)
            except Exception as error:  # whatever happens, every client gets an answer and the lane goes on
                for request in batch:
                    request.fail_unexpectedly(error)
            for request in batch:
                if not request.held and not request.answered:
                    request.fail_unexpectedly(RuntimeError("left without an answer"))
            if self._rests and self._queue:
                self._ending.wait(time.monotonic() - began)

    def _take(self) -> list[_Job]:
        """What waits, as much as may be worked off together; nothing only once the lane closes."""
        while True:
            with self._lock:
                if self._queue or self._closing:
                    return self._next()
                self._asleep = True
            self._bell.acquire()

    def _next(self) -> list[_Job]:
        batch: list[_Job] = []
        size = 0
        while self._queue and len(batch) < self._most and size <= _BATCH_BYTES:
            batch.append(self._queue.popleft())
            size += batch[-1].size
            self._waiting[batch[-1].verb] -= 1
        self._bytes -= size
        return batch


def busy(verb: str) -> Busy:
    """What is answered when a queue is full."""
    return Busy(f"too many requests of {verb!r} are waiting already; ask again later", retry_ms=_RETRY_MS)
