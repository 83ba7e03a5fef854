"""The workers of each task: their liveliness, and their open trials, which are not reported yet."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain
from operator import itemgetter
from typing import Any, Final, final

import zenoh

from crkr.protocol import live_worker_key
from crkr.protocol.keys import left_worker_key
from crkr.server.thread_faults import keep_running

__all__ = ["STATES", "Workers"]

logger = logging.getLogger(__name__)

STATES: Final = ("alive", "left", "lost", "unannounced")
# Bounds by kind of name; the least recently seen name is dropped first. Made-up names in requests only push out each
# other, not workers with a token.
_MOST_ALIVE: Final = 16_384
_MOST_ANNOUNCED: Final = 4096  # not alive
_MOST_UNANNOUNCED: Final = 1024
_MOST_OPEN: Final = 4096  # trials of a worker; the oldest is dropped first
_LONGEST_ID: Final = 128  # characters; status lists ids
_MOST_OPEN_IN_ALL: Final = 65_536  # then the worker with most loses some, first those without a token
_FEW: Final = 64  # open trials of an ordinary worker
_LONGEST_KEY: Final = 512  # of a token
_FIFO: Final = 65536
# One subscription to both kinds of token keeps their order: `left` before the end of the worker's own.
_TOKENS: Final = live_worker_key("*", "*").replace("/worker/", "/*/")
_WORKER, _LEFT = (key("*", "*").split("/")[-2] for key in (live_worker_key, left_worker_key))


@final
class _Worker:
    __slots__ = ("alive", "announced", "last_seen", "left", "most", "open", "seen")

    def __init__(self) -> None:
        self.alive = self.announced = self.left = False
        self.open: OrderedDict[bytes, float] = OrderedDict()  # trial -> when it was asked for, the oldest first
        self.most = 0  # most open trials since the table was made
        self.see()

    def shrink(self) -> None:
        """Rebuild the table of open trials once it is far too large, as removing entries frees no memory."""
        if self.most > _FEW and len(self.open) < self.most // 4:
            self.open = OrderedDict(self.open)
            self.most = len(self.open)

    def see(self) -> None:
        """Record a sign of life: time of day for display, monotonic time for comparison."""
        self.last_seen, self.seen = time.time(), time.monotonic()

    @property
    def state(self) -> str:
        if self.alive:
            return "alive"
        return "left" if self.left else "lost" if self.announced else "unannounced"


def _opened(entry: _Worker) -> int:
    return len(entry.open)


_Names = OrderedDict[tuple[str, str], _Worker]


@final
class Workers:
    """Workers of all tasks, known by their tokens or by the names in their requests."""

    def __init__(self) -> None:
        # With a token, with a former token, without; least recently seen first.
        self._alive: _Names = OrderedDict()
        self._gone: _Names = OrderedDict()
        self._unannounced: _Names = OrderedDict()
        self._open = 0
        self._lock = threading.Lock()
        self._tokens: object = None  # of the session that is followed
        self._thread: threading.Thread | None = None

    def watch(self, session: zenoh.Session) -> None:
        """Follow the liveliness tokens of a session, existing ones included, until it closes.

        Workers of the previous session are lost until their tokens appear in this one.
        """
        with self._lock:
            for name, entry in list(self._alive.items()):
                entry.alive = False
                self._sort_in(name, entry)
        tokens = session.liveliness().declare_subscriber(_TOKENS, zenoh.handlers.FifoChannel(_FIFO), history=True)
        self._tokens = tokens
        self._thread = threading.Thread(
            target=keep_running, args=(partial(self._follow, tokens),), name="liveliness", daemon=True
        )
        self._thread.start()

    def join(self, patience_s: float) -> None:
        """Wait for the end of `watch`, after the session was closed."""
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(patience_s)

    def asked(self, task: str, worker: str, trials: Iterable[bytes]) -> None:
        """Record goals given to a worker."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            before = len(entry.open)
            for trial in trials:
                entry.open[trial] = entry.seen
                entry.open.move_to_end(trial)
            entry.most = max(entry.most, len(entry.open))
            while len(entry.open) > _MOST_OPEN:
                entry.open.popitem(last=False)
            self._open += len(entry.open) - before
            if self._open > _MOST_OPEN_IN_ALL:
                self._forget_oldest()

    def reported(self, task: str, worker: str, trials: Iterable[bytes]) -> None:
        """Record reported trials of a worker, late ones too."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            for trial in trials:
                self._open -= entry.open.pop(trial, None) is not None
            entry.shrink()

    def status(self, task: str) -> list[dict[str, Any]]:
        """The task's workers as `status` lists them."""
        with self._lock:
            now = time.monotonic()
            found = [
                {
                    "id": worker,
                    "state": entry.state,
                    "open_trials": len(entry.open),
                    "oldest_open_s": now - next(iter(entry.open.values())) if entry.open else None,
                    "last_seen": entry.last_seen,
                    "last_seen_s": now - entry.seen,
                }
                for (owner, worker), entry in self._all()
                if owner == task
            ]
        return sorted(found, key=itemgetter("id"))

    def totals(self) -> dict[str, tuple[Counter[str], int]]:
        """Task -> its workers by state, and their number of open trials."""
        with self._lock:
            known = [(task, entry.state, len(entry.open)) for (task, _), entry in self._all()]
        found: dict[str, tuple[Counter[str], int]] = {}
        for task, state, count in known:
            states, opened = found.get(task, (Counter[str](), 0))
            states[state] += 1
            found[task] = states, opened + count
        return found

    def _all(self) -> Iterator[tuple[tuple[str, str], _Worker]]:
        return chain(self._alive.items(), self._gone.items(), self._unannounced.items())

    def _entry(self, task: str, worker: str) -> _Worker:
        """The worker of that name, moved to the end as the last seen."""
        name = task, worker
        for names in (self._alive, self._gone, self._unannounced):
            if name in names:
                names.move_to_end(name)
                return names[name]
        entry = self._unannounced[name] = _Worker()
        self._forget_names(self._unannounced, _MOST_UNANNOUNCED)
        return entry

    def _sort_in(self, name: tuple[str, str], entry: _Worker) -> None:
        """Move a worker whose token came or went to its kind."""
        for names in (self._alive, self._gone, self._unannounced):
            names.pop(name, None)
        (self._alive if entry.alive else self._gone)[name] = entry
        self._forget_names(self._alive, _MOST_ALIVE)
        self._forget_names(self._gone, _MOST_ANNOUNCED)

    def _forget_names(self, names: _Names, most: int) -> None:
        while len(names) > most:
            self._open -= len(names.popitem(last=False)[1].open)

    def _forget_oldest(self) -> None:
        """Halve the open trials of the worker with most, until there is room: ordinary workers have few."""
        while self._open > _MOST_OPEN_IN_ALL:
            most = max(self._unannounced.values(), key=_opened, default=None)
            if most is None or len(most.open) < _FEW:
                most = max((entry for _, entry in self._all()), key=_opened)
            for _ in range((len(most.open) + 1) // 2):
                most.open.popitem(last=False)
                self._open -= 1
            most.shrink()

    def _follow(self, tokens: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> bool:
        try:
            sample = tokens.recv()
        except zenoh.ZError:  # the session is closed
            return False
        if tokens is not self._tokens:  # the end of a previous session, whose workers are in another now
            return False
        key = str(sample.key_expr)
        if len(key) > _LONGEST_KEY:
            return True
        match key.split("/"):
            case [_, _, _, task, _, what, worker] if len(worker) <= _LONGEST_ID:
                stands = sample.kind == zenoh.SampleKind.PUT
                if what == _LEFT:
                    self._leave(task, worker, stands)
                elif what == _WORKER:
                    self.note_token(task, worker, stands)
        return True  # a token with a wildcard belongs to no worker

    def _leave(self, task: str, worker: str, stands: bool) -> None:
        with self._lock:
            name = task, worker
            entry = self._alive.get(name) or self._gone.get(name) or self._unannounced.get(name)
            if entry is not None and stands:
                entry.left = True

    def note_token(self, task: str, worker: str, stands: bool) -> None:
        """A worker's token was declared or withdrawn."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            entry.alive, entry.announced = stands, True
            entry.left = entry.left and not stands
            self._sort_in((task, worker), entry)
            state = entry.state
        logger.info("worker %s of task %s: %s", worker, task, state)
