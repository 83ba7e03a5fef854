"""Who works on which task: alive by their liveliness tokens, with the trials they were given and did not report yet."""

from __future__ import annotations

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from typing import Any, Final, final

import zenoh

from crkr.protocol import live_worker_key

__all__ = ["Workers"]

logger = logging.getLogger(__name__)

_MOST_WORKERS: Final = 4096  # the longest unseen is forgotten first
_MOST_OPEN: Final = 4096  # trials a worker, the oldest is forgotten first
_FIFO: Final = 65536


@final
class _Worker:
    __slots__ = ("alive", "announced", "last_seen", "open")

    def __init__(self) -> None:
        self.alive = self.announced = False
        self.last_seen = time.time()
        self.open: OrderedDict[bytes, None] = OrderedDict()


@final
class Workers:
    """Workers of all tasks, known by their tokens or by the name they ask and report under."""

    def __init__(self) -> None:
        self._known: OrderedDict[tuple[str, str], _Worker] = OrderedDict()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def watch(self, session: zenoh.Session) -> None:
        """Follows the tokens from now on, those that stand already too; ends with the session."""
        tokens = session.liveliness().declare_subscriber(
            live_worker_key("*", "*"), zenoh.handlers.FifoChannel(_FIFO), history=True
        )
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
            entry.last_seen = time.time()
            for trial in trials:
                entry.open[trial] = None
                entry.open.move_to_end(trial)
            while len(entry.open) > _MOST_OPEN:
                entry.open.popitem(last=False)

    def reported(self, task: str, worker: str, trials: Iterable[bytes]) -> None:
        """A worker reported trials; a late report is as good as any."""
        with self._lock:
            entry = self._entry(task, worker)
            entry.last_seen = time.time()
            for trial in trials:
                entry.open.pop(trial, None)

    def status(self, task: str) -> list[dict[str, Any]]:
        """The task's workers as `status` lists them."""
        with self._lock:
            return [
                {
                    "id": worker,
                    "state": "alive" if entry.alive else "lost" if entry.announced else "unannounced",
                    "open_trials": len(entry.open),
                    "last_seen": entry.last_seen,
                }
                for (owner, worker), entry in sorted(self._known.items(), key=lambda item: item[0])
                if owner == task
            ]

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
            *_, task, _, _, worker = str(sample.key_expr).split("/")
            alive = sample.kind == zenoh.SampleKind.PUT
            with self._lock:
                entry = self._entry(task, worker)
                entry.alive, entry.announced, entry.last_seen = alive, True, time.time()
            logger.info("worker %s of task %s is %s", worker, task, "alive" if alive else "gone")
