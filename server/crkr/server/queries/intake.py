"""The intake receives queries from Zenoh: it answers short predictions, queues the rest, and refuses the excess.

Zenoh's threads only put each query into a channel, which one thread drains, so that no client can block the others. If
a client sends more than can be refused, the channel fills up and its connection waits. The channel is short, because
all clients wait behind its content. This thread answers quick predictions itself, tasks in turn, as a hand-over would
cost as much. If a client does not read its answers, another thread takes over. All other requests wait in a lane.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final, final

import zenoh

from crkr.protocol import CrkrError, Internal, ShuttingDown, UnknownTask, Unsupported
from crkr.server.metrics.durations import OTHER_VERB, Latencies
from crkr.server.queries.fair_queue import RoundRobin
from crkr.server.queries.queue import Lane, busy, shutting_down
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request, held_bytes, let_go, refuse
from crkr.server.queries.standby_thread import StandbyThread
from crkr.server.thread_faults import keep_running, run_once

__all__ = ["Intake"]

logger = logging.getLogger(__name__)

_CHANNEL: Final = 1024  # queries; drained within a tenth of a second
_ROUND: Final = 64  # queries received between two answers
_BATCH: Final = 64  # predictions answered together
_SMALL: Final = 4096  # bytes; a larger predict goes to a lane


@final
class _Source:
    """The queries of one session, and its waiting predictions; for one thread at a time."""

    __slots__ = ("queries", "waiting")

    def __init__(self, queries: zenoh.Queryable[zenoh.handlers.Handler[zenoh.Query]]) -> None:
        self.queries = queries
        self.waiting = RoundRobin()


@final
class Intake:
    """One queryable and the threads that drain it, one at a time.

    Args:
        lanes: Verb -> the lane of its requests.
        refuser: Sends refusals, as a client that does not read them must not block this thread.
        predict: Answers predict requests on the intake thread and returns those left over: patient ones for their lane,
            the others for the next round. None: this key has no predictions.
        check_task: Raises `UnknownTask` for a task that is not served, so that its requests take no turns, and
            `ShuttingDown` for a task of another server. None: not checked here.
        ask_again: Called with a request for an unknown task; returns whether it will be answered elsewhere. Raises
            `ShuttingDown` if the request is to be dropped, so that its client asks again.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        lanes: Mapping[str, Lane[Any]],
        latencies: Latencies,
        refuser: Refuser,
        predict: Callable[[list[Request]], Sequence[Request]] | None = None,
        check_task: Callable[[str], object] | None = None,
        ask_again: Callable[[Request], bool] = lambda _: False,
    ) -> None:
        self._lanes, self._latencies, self._refuser, self._predict = lanes, latencies, refuser, predict
        self._check_task, self._ask_again = check_task, ask_again
        # Drops queries that are not answered. That sends something too, hence may block, and is done with the answers.
        self._surplus: deque[Callable[[], None]] = deque()
        self._stopping = False
        self._key = key
        self._source = self._declare(session)
        self._thread = StandbyThread(self._run, f"intake {key}")

    def start(self) -> None:
        """Start to receive queries."""
        self._thread.start()

    def move(self, session: zenoh.Session) -> None:
        """Receive queries from another session; the previous one is closed."""
        self._source = self._declare(session)
        self._thread.start()

    def _declare(self, session: zenoh.Session) -> _Source:
        return _Source(session.declare_queryable(self._key, zenoh.handlers.FifoChannel(_CHANNEL), complete=True))

    def stop(self) -> None:
        """Answer every query with SHUTTING_DOWN from now on; the thread ends with the session."""
        self._stopping = True

    def join(self, patience_s: float) -> None:
        """Wait for the thread to end, after the session was closed."""
        self._thread.join(patience_s)

    def _run(self, turn: int) -> None:
        keep_running(partial(self._round, turn, self._source))

    def _round(self, turn: int, source: _Source) -> bool:
        """Receive queries and answer predictions; False if another thread took over or the session is closed."""
        try:
            if not (source.waiting or self._surplus):
                self._route(source.queries.recv(), source)
            self._drain(source)
        except zenoh.ZError:  # the session is closed
            for request in source.waiting.take(len(source.waiting)):
                request.fail(shutting_down())
            return False
        return self._answer(turn, source)

    def _drain(self, source: _Source) -> None:
        """Receive waiting queries, few enough not to delay predictions."""
        for _ in range(_ROUND):
            query = source.queries.try_recv()
            if query is None:
                return
            self._route(query, source)

    def _answer(self, turn: int, source: _Source) -> bool:
        """Answer predictions; False if that blocked until another thread took over."""
        if not (self._surplus or (source.waiting and self._predict is not None)):
            return True
        batch = [] if self._predict is None else source.waiting.take(_BATCH)
        left: Sequence[Request] = ()
        try:
            self._thread.begin(turn)
            if batch and self._predict is not None:
                left = self._predict(batch)
        except BaseException as error:
            for request in batch:
                request.fail_unexpectedly(error)
        self._drop_surplus()
        on_duty = self._thread.end(turn)
        if left and on_duty:
            source.waiting.put_back([request for request in left if not request.patient])
        for request in left:
            if request.patient or not on_duty:
                try:
                    self._hand_over(request)
                except BaseException as error:  # the others are handed over
                    self._surplus.append(partial(request.fail_unexpectedly, error))
        if not on_duty:  # the thread that took over may wait for its next query
            self._drop_surplus()
        return on_duty

    def _drop_surplus(self) -> None:
        """Drop what waits for it; may block."""
        for _ in range(len(self._surplus)):
            with suppress(IndexError):  # a thread that took over, or was replaced, drops some of it too
                run_once(self._surplus.popleft())

    def _drop(self, request: Request) -> None:
        self._surplus.append(request.let_go)

    def _route(self, query: zenoh.Query, source: _Source) -> None:
        """Answer or queue any query; never raises."""
        try:
            request = Request(query, self._latencies)
            if self._stopping:
                if self._is_served(request):
                    self._refuse(request, shutting_down())
            elif request.verb == "predict" and self._predict is not None and request.size <= _SMALL:
                self._wait(request, source.waiting)
            else:
                self._hand_over(request)
        except CrkrError as error:
            self._turn_away(query, error)
        except Exception:
            logger.exception("a query on %.80s could not be taken", query.key_expr)
            self._turn_away(query, Internal("the query failed by a defect of the server; see its log"))

    def _turn_away(self, query: zenoh.Query, error: CrkrError) -> None:
        """Refuse a query that is not a request of the protocol."""
        self._latencies.refused(OTHER_VERB, error.code)
        if not self._refuser.add(partial(refuse, query), error, held_bytes(query)):
            self._surplus.append(partial(let_go, query))

    def _refuse(self, request: Request, error: CrkrError) -> None:
        if not self._refuser.add(request.fail, error, request.held_bytes()):
            self._drop(request)

    def _wait(self, request: Request, waiting: RoundRobin) -> None:
        if self._is_served(request) and not waiting.add(request):
            self._refuse(request, busy(request.verb))

    def _hand_over(self, request: Request) -> None:
        request.patient = True
        lane = self._lanes.get(request.verb)
        if lane is None:
            self._refuse(request, self._unknown(request.verb))
        elif self._is_served(request):
            request.read_metadata()
            refusal = lane.offer(request)
            if refusal is not None:
                self._refuse(request, refusal)

    def _is_served(self, request: Request) -> bool:
        """Whether the task is served; if not, refuses the request, or drops it if another server answers."""
        try:
            try:
                if self._check_task is not None:
                    self._check_task(request.task)
            except UnknownTask as error:
                if not self._ask_again(request):
                    self._refuse(request, error)
                return False
        except ShuttingDown:
            self._drop(request)
            return False
        return True

    def _unknown(self, verb: str) -> Unsupported:
        return Unsupported(f"verb {verb!r:.80} is not offered here; these are: {', '.join(sorted(self._lanes))}")
