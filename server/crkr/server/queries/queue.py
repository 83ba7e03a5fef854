"""A lane: a bounded queue for each verb, and one thread that answers its requests.

A client with an id may hold only a share of a lane. Requests that their client has given up are dropped, and a repeated
question joins the one already waiting.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Generic, TypeVar, final

from crkr.protocol import Busy, CrkrError, ShuttingDown
from crkr.server.queries.fair_queue import FairQueue
from crkr.server.queries.request import Job, Request
from crkr.server.thread_faults import keep_running

__all__ = ["Lane", "busy", "shutting_down"]

_RETRY_MS: Final = 50
_MOST_BYTES: Final = 64 * 2**20  # requests that may wait in a lane
_BATCH_BYTES: Final = 2 * 2**20  # after which a batch is not extended
_FEW: Final = 8  # requests of a task that may always wait
_FIRST_S: Final = 0.01  # estimate before the first step
_WEIGHT: Final = 0.25  # weight of the newest in the mean
_SHARE: Final = 4  # largest share of one client, in requests and in bytes
_Job = TypeVar("_Job", bound=Job)


def shutting_down() -> ShuttingDown:
    """The answer to requests while the server stops."""
    return ShuttingDown("the server is shutting down; ask its successor", retry_ms=200)


@final
class Lane(Generic[_Job]):
    """Answers requests in order of arrival, in batches where the work can use them.

    Args:
        name: Name of the thread.
        limits: Verb -> how many requests may wait; more are refused with `Busy`.
        work: Answers a batch. If it raises, the lane answers with the error. It may return unfinished requests, which
            wait for their next turn.
        most: Largest batch. A batch is what is waiting; nothing waits for it to fill.
        rests: While work is queued, sleep as long as the last batch took, so that a flooding client gets at most half a
            core.
        fair: Tasks, and the clients of each, take turns. If not, requests keep their order.
        keeps_order: In a fair lane, requests of one client for one task keep their order, as writing needs.
        patience_s: How long a request without a deadline may wait before it is refused with `Busy`; one with a deadline
            is refused once that has passed. None: deadlines are ignored.
        joins: Answer repeats of a waiting question together with it.
        longest_s: Refuse a request that would probably wait longer than this for its turn. None: do not. For fair
            lanes.
    """

    def __init__(
        self,
        name: str,
        limits: Mapping[str, int],
        work: Callable[[list[_Job]], Sequence[_Job] | None],
        most: int = 1,
        *,
        rests: bool = False,
        fair: bool = False,
        keeps_order: bool = False,
        patience_s: float | None = None,
        joins: bool = False,
        longest_s: float | None = None,
    ) -> None:
        self._limits, self._work, self._most, self._rests = dict(limits), work, most, rests
        self._patience_s, self._joins, self._longest_s = patience_s, joins, longest_s
        self._step_s = _FIRST_S  # estimated time of a step, its rest included
        self._queue: deque[_Job] | FairQueue[_Job] = FairQueue(keeps_order) if fair else deque()
        self._waiting: Counter[str] = Counter()
        self._bytes = 0
        # Client -> its requests of each verb, and their bytes.
        self._of_clients: Counter[tuple[bytes, str]] = Counter()
        self._asked: dict[tuple[Any, ...], Request] = {}  # questions that may be joined, by fingerprint
        # Earlier repeats, to be dropped. That may block, as answers to the same client do, hence is this thread's work.
        self._over: list[Request] = []
        self._lock = threading.Lock()
        # Releasing a lock wakes the thread in half the time of a condition.
        self._bell = threading.Lock()
        self._bell.acquire()
        self._asleep = self._closing = False
        self._ending = threading.Event()
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name=name, daemon=True)

    def start(self) -> None:
        """Start to work."""
        self._thread.start()

    def offer(self, request: _Job) -> CrkrError | None:
        """Queue a request, or return a refusal for the caller to send."""
        question = request if self._joins and isinstance(request, Request) else None
        if question is not None:
            question.identify()
        with self._lock:
            if question is not None and question.fingerprint is not None:
                known = self._asked.get(question.fingerprint)
                if known is not None:
                    return self._join(known, question)
            full = self._is_full(request)
            if full or self._closing:
                return busy(request.verb) if full else shutting_down()
            if question is not None and question.fingerprint is not None:
                self._asked[question.fingerprint] = question
            self._count(request, 1)
            self._queue.append(request)
            ring, self._asleep = self._asleep, False
        if ring:
            self._bell.release()
        return None

    def _join(self, known: Request, repeat: Request) -> CrkrError | None:
        if len(self._over) >= self._limits[repeat.verb] or self._bytes + repeat.size > _MOST_BYTES:
            return busy(repeat.verb)
        over = known.join(repeat)
        if over is not None:
            self._over.append(over)
            self._bytes += over.size
        return None

    def _is_full(self, request: _Job) -> bool:
        limit, verb, client = self._limits[request.verb], request.verb, request.client
        if self._waiting[verb] >= limit or (self._queue and self._bytes + request.size > _MOST_BYTES):
            return True
        if self._waits_long(request.task):
            return True
        if not client or not self._of_clients[client, verb]:
            return False
        size = self._of_clients[client, ""] + request.size
        return self._of_clients[client, verb] >= max(1, limit // _SHARE) or size > _MOST_BYTES // _SHARE

    def _waits_long(self, task: str) -> bool:
        if self._longest_s is None or not isinstance(self._queue, FairQueue):
            return False
        turns = self._queue.wait(task)
        return turns >= _FEW and turns * self._step_s > self._longest_s

    def _count(self, request: _Job, sign: int) -> None:
        self._waiting[request.verb] += sign
        self._bytes += sign * request.size
        if request.client:
            for name, amount in ((request.verb, 1), ("", request.size)):
                self._of_clients[request.client, name] += sign * amount
                if not self._of_clients[request.client, name]:
                    del self._of_clients[request.client, name]

    def depths(self) -> dict[str, Any]:
        """Verb -> number of waiting requests, and the limit."""
        return {verb: {"waiting": self._waiting[verb], "limit": limit} for verb, limit in self._limits.items()}

    def close(self, patience_s: float) -> None:
        """Accept no more requests, work on the rest for `patience_s`, then refuse those left."""
        self._ending.set()
        with self._lock:
            self._closing = True
            ring, self._asleep = self._asleep, False
        if ring:
            self._bell.release()
        if self._thread.is_alive():
            self._thread.join(patience_s)
        with self._lock:
            left = list(self._queue) if isinstance(self._queue, deque) else self._queue.clear()
            if isinstance(self._queue, deque):
                self._queue.clear()
        for request in left:
            request.fail(shutting_down())
            self._finish(request)
        self._drop_over()

    def _step(self) -> bool:
        batch, late = self._take()
        for request in late:
            request.fail(Busy("its turn would come after its deadline; ask again later", retry_ms=_RETRY_MS))
            self._finish(request)
        began = time.monotonic()
        unfinished = self._attempt(batch) if batch else ()
        self._drop_over()
        if unfinished:
            with self._lock:
                for request in unfinished:
                    self._count(request, 1)
                    if isinstance(self._queue, FairQueue):
                        self._queue.put_back(request)
                    else:
                        self._queue.appendleft(request)
        took = time.monotonic() - began
        if self._rests and self._queue:
            self._ending.wait(took)
        if batch:
            took *= 2 if self._rests else 1
            self._step_s += _WEIGHT * (took - self._step_s)
        return bool(batch or late)

    def _attempt(self, batch: list[_Job]) -> Sequence[_Job]:
        """Work on a batch; every request is answered, also after an error."""
        unfinished: Sequence[_Job] = ()
        try:
            unfinished = self._work(batch) or ()
        except BaseException as error:
            for request in batch:
                request.fail_unexpectedly(error)
        for request in batch:
            if request in unfinished:
                continue
            if not request.held and not request.answered:
                request.fail_unexpectedly(RuntimeError("left without an answer"))
            self._finish(request)
        return unfinished

    def _finish(self, request: _Job) -> None:
        """Answer the repeats that joined; no more may join."""
        if isinstance(request, Request) and request.fingerprint is not None:
            with self._lock:
                self._asked.pop(request.fingerprint, None)
            request.answer_repeats()

    def _drop_over(self) -> None:
        if not self._over:  # if some come now, so does another step: their question waits
            return
        with self._lock:
            over, self._over = self._over, []
            self._bytes -= sum(request.size for request in over)
        for request in over:
            request.let_go()

    def _take(self) -> tuple[list[_Job], list[_Job]]:
        """The next batch and the requests that waited too long; both empty once the lane closes."""
        while True:
            with self._lock:
                if self._queue or self._closing:
                    return self._next()
                self._asleep = True
            self._bell.acquire()

    def _next(self) -> tuple[list[_Job], list[_Job]]:
        batch: list[_Job] = []
        late: list[_Job] = []
        size = 0
        while self._queue and len(batch) < self._most and size <= _BATCH_BYTES:
            request = self._queue.popleft()
            self._count(request, -1)
            if self._patience_s is not None and self._is_late(request):
                late.append(request)
            else:
                batch.append(request)
                size += request.size
        return batch, late

    def _is_late(self, request: _Job) -> bool:
        known = request.deadline != math.inf
        until = request.deadline if known else request.received + (self._patience_s or 0.0)
        return time.perf_counter() > until


def busy(verb: str) -> Busy:
    """The answer when a queue is full."""
    return Busy(f"too many requests of {verb!r} are waiting already; ask again later", retry_ms=_RETRY_MS)
