"""Who works on which task: alive by their liveliness tokens, with the trials they were given and did not report yet."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Iterable
from operator import itemgetter
from typing import Any, Final, final

import zenoh

from crkr.protocol import live_worker_key
from crkr.protocol.keys import left_worker_key

__all__ = ["STATES", "Workers"]

logger = logging.getLogger(__name__)

STATES: Final = ("alive", "left", "lost", "unannounced")
_MOST_WORKERS: Final = 4096  # the longest unseen is forgotten first
_MOST_OPEN: Final = 4096  # trials a worker, the oldest is forgotten first
_LONGEST_ID: Final = 128  # characters; status lists ids
_FIFO: Final = 65536
# One subscription to both kinds of token, so that a worker's leaving comes before the end of its own.
_TOKENS: Final = live_worker_key("*", "*").replace("/worker/", "/*/")
_WORKER, _LEFT = (key("*", "*").split("/")[-2] for key in (live_worker_key, left_worker_key))


@final
class _Worker:
    __slots__ = ("alive", "announced", "last_seen", "left", "open", "seen")

    def __init__(self) -> None:
        self.alive = self.announced = self.left = False
        self.open: OrderedDict[bytes, float] = OrderedDict()  # trial -> when it was asked for, the oldest first
        self.see()

    def see(self) -> None:
        """Notes that it gave a sign just now: the time of day to be told, the monotonic one to be compared."""
        self.last_seen, self.seen = time.time(), time.monotonic()

    @property
    def state(self) -> str:
        if self.alive:
            return "alive"
        return "left" if self.left else "lost" if self.announced else "unannounced"


@final
class Workers:
    """Workers of all tasks, known by their tokens or by the name they ask and report under."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[str, str], _Worker] = OrderedDict()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def watch(self, session: zenoh.Session) -> None:
        """Follows the tokens from now on, those that stand already too; ends with the session."""
        tokens = session.liveliness().declare_subscriber(_TOKENS, zenoh.handlers.FifoChannel(_FIFO), history=True)
        self._thread = threading.Thread(target=self._follow, args=(tokens,), name="liveliness", daemon=True)
        self._thread.start()

    def join(self, patience_s: float) -> None:
        """Waits for the end of `watch`, after the session was closed."""
        if self._thread is not None:
            self._thread.join(patience_s)

    def asked(self, task: str, worker: str, trials: Iterable[bytes]) -> None:
        """A worker was given goals to try."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            for trial in trials:
                entry.open[trial] = entry.seen
                entry.open.move_to_end(trial)
            while len(entry.open) > _MOST_OPEN:
                entry.open.popitem(last=False)

    def reported(self, task: str, worker: str, trials: Iterable[bytes]) -> None:
        """A worker reported trials; a late report is as good as any."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            for trial in trials:
                entry.open.pop(trial, None)

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
                for (owner, worker), entry in self._known.items()
                if owner == task
            ]
        return sorted(found, key=itemgetter("id"))

    def totals(self) -> dict[str, tuple[Counter[str], int]]:
        """Task -> its workers by state, and how many trials they have open."""
        with self._lock:
            known = [(task, entry.state, len(entry.open)) for (task, _), entry in self._known.items()]
        found: dict[str, tuple[Counter[str], int]] = {}
        for task, state, count in known:
            states, opened = found.get(task, (Counter[str](), 0))
            states[state] += 1
            found[task] = states, opened + count
        return found

    def _entry(self, task: str, worker: str) -> _Worker:
        entry = self._known.setdefault((task, worker), _Worker())
        self._known.move_to_end((task, worker))
        while len(self._known) > _MOST_WORKERS:
            self._known.popitem(last=False)
        return entry

    def _follow(self, tokens: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> None:
        while True:
            try:
                sample = tokens.recv()
            except zenoh.ZError:  # the session is closed
                return
            match str(sample.key_expr).split("/"):
                case [_, _, _, task, _, what, worker] if len(worker) <= _LONGEST_ID:
                    pass
                case _:  # a token on a wildcard, or under no worker's id: it is nobody's
                    continue
            stands = sample.kind == zenoh.SampleKind.PUT
            if what == _LEFT:
                self._leave(task, worker, stands)
            elif what == _WORKER:
                self._appear(task, worker, stands)

    def _leave(self, task: str, worker: str, stands: bool) -> None:
        with self._lock:
            entry = self._known.get((task, worker))
            if entry is not None and stands:
                entry.left = True

    def _appear(self, task: str, worker: str, stands: bool) -> None:
        with self._lock:
            entry = self._entry(task, worker)
            entry.see()
            entry.alive, entry.announced = stands, True
            entry.left = entry.left and not stands
            state = entry.state
        logger.info("worker %s of task %s: %s", worker, task, state)
