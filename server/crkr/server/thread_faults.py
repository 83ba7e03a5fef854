"""Faults of the server's threads: whatever a thread raises is counted and told, and the thread goes on.

`except Exception` is not enough for that. A panic in the Rust beneath a binding arrives as a `BaseException`, and a
lane that ends by it leaves everyone behind it without an answer while the process looks well.
"""

from __future__ import annotations

import logging
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, final

__all__ = ["FAULTS", "ThreadFaults", "is_panic", "keep_running", "run_once"]

logger = logging.getLogger(__name__)

_MOST_NAMES: Final = 64  # of threads, in the counts
_OTHER: Final = "other"
_UNNAMED: Final = re.compile(r"Thread-\d+(?: \((.*)\))?")
_LONGEST_PAUSE_S: Final = 1.0  # before the next try of what fails again and again


@final
class ThreadFaults:
    """Counts by thread name since the start; any thread may read and add."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()
        self._on_panic: Callable[[], None] | None = None

    def call_on_panic(self, on_panic: Callable[[], None] | None) -> None:
        """Calls this after each panic of a binding, on the thread that saw it; None: nothing from now on."""
        self._on_panic = on_panic

    def note(self, error: BaseException, thread: str | None = None) -> None:
        """Counts what this thread, or the named one, survived. Never raises.

        The log has the first traceback of a thread, then those whose number is a power of two: a client that causes a
        fault with each message does not fill the disk.
        """
        with suppress(BaseException):
            name = self._counted(self._counts, thread or threading.current_thread().name)
            count = self._counts[name]
            if count & (count - 1) == 0:
                logger.error("thread %s goes on after fault %d: %r", name, count, error, exc_info=error)
            if self._on_panic is not None and is_panic(error):
                self._on_panic()

    def note_end(self, error: BaseException | None, thread: str) -> None:
        """Counts a thread that ended by what it raised. Never raises."""
        with suppress(BaseException):
            name = self._counted(self._ended, thread)
            logger.critical("thread %s ended; restart the server: %r", name, error, exc_info=error)

    def watch(self) -> None:
        """Notes every thread of the process that ends by an exception from now on."""
        before = threading.excepthook

        def hook(ended: threading.ExceptHookArgs) -> None:
            self.note_end(ended.exc_value, "" if ended.thread is None else ended.thread.name)
            before(ended)

        threading.excepthook = hook

    def counts(self) -> dict[str, int]:
        """Thread -> how often it raised something and went on."""
        with self._lock:
            return dict(self._counts)

    def ended(self) -> list[str]:
        """Threads that are no more although the server needs them."""
        with self._lock:
            return sorted(self._ended)

    def summary(self) -> dict[str, Any]:
        """As `info` and `status` tell it; empty while nothing went wrong."""
        counts, ended = self.counts(), self.ended()
        return {"faults": counts, "ended": ended} if counts or ended else {}

    def _counted(self, counter: Counter[str], thread: str) -> str:
        if unnamed := _UNNAMED.fullmatch(thread):
            thread = unnamed[1] or "unnamed"
        with self._lock:
            name = thread if thread in counter or len(counter) < _MOST_NAMES else _OTHER
            counter[name] += 1
        return name


# One for the process, as its threads and `threading.excepthook` are.
FAULTS: Final = ThreadFaults()


def is_panic(error: BaseException) -> bool:
    """Whether the Rust beneath a binding raised it; its type has no importable name."""
    return type(error).__name__ == "PanicException"


def keep_running(step: Callable[[], bool]) -> None:
    """The whole of a thread: calls `step` until it returns False, whatever it raises meanwhile."""
    failures, pause = 0, threading.Event()
    while True:
        try:
            if not step():
                return
            failures = 0
        except BaseException as error:
            FAULTS.note(error)
            failures += 1
            if failures > 1 and not sys.is_finalizing():
                pause.wait(min(_LONGEST_PAUSE_S, 0.001 * 2.0 ** min(failures, 20)))


def run_once(work: Callable[[], None]) -> None:
    """The whole of a thread that has one thing to do; what it raises is noted, and the thread is done."""
    try:
        work()
    except BaseException as error:
        FAULTS.note(error)
