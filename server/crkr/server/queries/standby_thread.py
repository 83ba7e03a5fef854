"""A worker thread that a fresh one replaces while a blocked reply holds it up.

A client that does not read its answers blocks the answering thread until Zenoh cuts its connection. The requests of
that turn wait; all others do not.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, final

from crkr.server.thread_faults import keep_running, started

__all__ = ["StandbyThread"]

_PATIENCE_S: Final = 0.05  # fifty times the usual time between `begin` and `end`
_MOST: Final = 16  # threads at once; a blocked one ends once it is free


@final
class StandbyThread:
    """Runs `work(turn)` on a thread, and the next turn on another one when that is blocked.

    `work` calls `begin` before what may block and `end` after it, and returns once `end` returns False. State shared
    with later turns may be touched only before `begin`, and after an `end` that returned True.
    """

    def __init__(self, work: Callable[[int], None], name: str) -> None:
        self._work, self._name = work, name
        self._lock = threading.Lock()
        self._turn = 0
        self._since: float | None = None  # when the current thread began what may block
        self._running: list[threading.Thread] = []
        self._ended = threading.Event()
        self._watch = threading.Thread(target=keep_running, args=(self._look,), name=f"{name} standby", daemon=True)

    def start(self) -> None:
        """Start the first turn, or the next one after a turn has ended."""
        with self._lock:
            self._begin_turn()

    def begin(self, turn: int) -> None:
        """The thread may block from now on."""
        with self._lock:
            if self._watch.ident is None:  # as late as possible: most are never blocked
                started(self._watch)  # without it, this thread is not replaced while it is blocked
            if turn == self._turn:
                self._since = time.monotonic()

    def end(self, turn: int) -> bool:
        """The thread is no longer blocked; False if another has replaced it."""
        with self._lock:
            if turn == self._turn:
                self._since = None
            return turn == self._turn

    def join(self, patience_s: float) -> None:
        """Wait for the current thread to end; it is not replaced any more."""
        self._ended.set()
        with self._lock:
            running = self._running[-1:]
        for thread in running:
            thread.join(patience_s)

    def _begin_turn(self) -> None:
        turn = self._turn + 1
        thread = threading.Thread(target=self._work, args=(turn,), name=self._name, daemon=True)
        thread.start()  # `end` waits for this lock; if no thread can start, the old turn continues
        self._turn, self._since = turn, None
        self._running.append(thread)

    def _look(self) -> bool:
        if self._ended.wait(_PATIENCE_S):
            return False
        with self._lock:
            if self._since is not None and time.monotonic() - self._since > _PATIENCE_S:
                self._running = [thread for thread in self._running if thread.is_alive()]
                if len(self._running) < _MOST:
                    self._begin_turn()
        return True
