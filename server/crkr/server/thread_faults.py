"""Faults of the server's threads: exceptions are counted and logged, and the thread continues.

`except Exception` is not enough: a Rust panic in a binding is a `BaseException`, and a lane that died of one would
leave requests unanswered in a process that looks healthy.
"""

from __future__ import annotations

import logging
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Final, final

from crkr.protocol import Unavailable
from crkr.protocol.zenoh_files import is_panic

__all__ = ["FAULTS", "ThreadFaults", "check_threads", "keep_running", "run_once", "started"]

logger = logging.getLogger(__name__)

_MOST_NAMES: Final = 64  # thread names in the counts
_OTHER: Final = "other"
_UNNAMED: Final = re.compile(r"Thread-\d+(?: \((.*)\))?")
_NEEDED: Final = 64  # threads of a server with few clients, and some for those that do not read their answers
_LONGEST_PAUSE_S: Final = 1.0  # between tries of a step that keeps failing


@final
class ThreadFaults:
    """Counts of faults by thread name; any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()
        self._on_panic: Callable[[BaseException], None] | None = None

    def call_on_panic(self, on_panic: Callable[[BaseException], None] | None) -> None:
        """Call `on_panic` with each panic of a binding, on the thread that saw it; None to stop."""
        self._on_panic = on_panic

    def note(self, error: BaseException, thread: str | None = None) -> None:
        """Record a fault that this thread, or the named one, survived. Never raises.

        Only faults number 1, 2, 4, 8, ... of a thread are logged, so that a client that causes one with each message
        does not fill the disk.
        """
        with suppress(BaseException):
            name = self._counted(self._counts, thread or threading.current_thread().name)
            count = self._counts[name]
            if count & (count - 1) == 0:
                logger.error("thread %s continues after fault %d: %r", name, count, error, exc_info=error)
            if self._on_panic is not None and is_panic(error):
                self._on_panic(error)

    def note_end(self, error: BaseException | None, thread: str) -> None:
        """Record a thread that ended by an exception. Never raises."""
        with suppress(BaseException):
            name = self._counted(self._ended, thread)
            logger.critical("thread %s ended; restart the server: %r", name, error, exc_info=error)

    def watch(self) -> None:
        """Record every thread of the process that ends by an exception from now on."""
        before = threading.excepthook

        def hook(ended: threading.ExceptHookArgs) -> None:
            self.note_end(ended.exc_value, "" if ended.thread is None else ended.thread.name)
            before(ended)

        threading.excepthook = hook

    def counts(self) -> dict[str, int]:
        """Thread -> number of faults it survived."""
        with self._lock:
            return dict(self._counts)

    def ended(self) -> list[str]:
        """Threads that ended although the server needs them."""
        with self._lock:
            return sorted(self._ended)

    def summary(self) -> dict[str, Any]:
        """The counts for `info` and `status`; empty without faults."""
        counts, ended = self.counts(), self.ended()
        return {"faults": counts, "ended": ended} if counts or ended else {}

    def _counted(self, counter: Counter[str], thread: str) -> str:
        if unnamed := _UNNAMED.fullmatch(thread):
            thread = unnamed[1] or "unnamed"
        with self._lock:
            name = thread if thread in counter or len(counter) < _MOST_NAMES else _OTHER
            counter[name] += 1
        return name


# One for the process, like its threads and `threading.excepthook`.
FAULTS: Final = ThreadFaults()


def keep_running(step: Callable[[], bool]) -> None:
    """Call `step` until it returns False, whatever it raises; for the body of a thread."""
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
                run_once(partial(pause.wait, min(_LONGEST_PAUSE_S, 0.001 * 2.0 ** min(failures, 20))))


def run_once(work: Callable[[], object]) -> None:
    """Call `work` once and record an error; for the body of a thread with one task."""
    try:
        work()
    except BaseException as error:
        FAULTS.note(error)


def started(thread: threading.Thread) -> bool:
    """Start a thread; False, and a fault of this one, where the system allows no more."""
    try:
        thread.start()
    except RuntimeError as error:
        FAULTS.note(error)
        return False
    return True


def check_threads() -> None:
    """Raise `Unavailable` if this process may not start the threads that a server needs."""
    over, waiting = threading.Event(), list[threading.Thread]()
    try:
        for _ in range(_NEEDED):
            waiting.append(threading.Thread(target=over.wait, daemon=True))
            waiting[-1].start()
    except RuntimeError as error:
        del waiting[-1]
        raise Unavailable(
            f"the system lets this process start {len(waiting)} threads, and a server needs {_NEEDED}: raise the limit "
            "of processes (ulimit -u, TasksMax of its unit, pids of its container) or of memory (ulimit -v)"
        ) from error
    finally:
        over.set()
        for thread in waiting:
            thread.join()
