"""A thread that asks the server for new trials and its status, so that drawing never waits for an answer."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.client import Task
from crkr.protocol import CrkrError, Internal, StoredTrial

__all__ = ["Poller", "Update"]

SAMPLES_EVERY_S: Final = 0.5
STATUS_EVERY_S: Final = 1.0
PAGE: Final = 1000
ANSWER_S: Final = 0.2  # longest wait for an answer at the end
INTERRUPTED_S: Final = 1.0


@final
@dataclass(frozen=True, slots=True)
class Update:
    """The answer to one question.

    Attributes:
        trials: New trials in the order of seq.
        more: Whether the log has more trials.
        status: The answer to `status`, or None.
        lost: Why the server did not answer, or None.
    """

    trials: tuple[StoredTrial, ...] = ()
    more: bool = False
    status: Mapping[str, Any] | None = None
    lost: CrkrError | None = None


@final
class Poller:
    """Read the log page by page from its beginning, then follow it; a context manager.

    Args:
        task: The task.
        interrupt: Aborts an open question at the end.
        after: Log position to read from.
        rest: Pause after each page of a long log, as a multiple of the page's time, to leave the server time for
            others.
    """

    def __init__(self, task: Task, interrupt: Callable[[], object], *, after: int = 0, rest: float = 0.0) -> None:
        self._task = task
        self._interrupt = interrupt
        self._after = after
        self._rest = rest
        self._stop = threading.Event()
        self._updates: queue.Queue[Update] = queue.Queue(maxsize=8)
        self._thread = threading.Thread(target=self._run, name="crkr-poller", daemon=True)

    def __enter__(self) -> Poller:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(timeout=ANSWER_S)
        if self._thread.is_alive():
            self._interrupt()
            self._thread.join(timeout=INTERRUPTED_S)

    def take(self) -> list[Update]:
        """The updates since the last call; never waits."""
        taken = []
        try:
            while True:
                taken.append(self._updates.get_nowait())
        except queue.Empty:
            return taken

    def _run(self) -> None:
        next_status = 0.0
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                more = self._ask_trials()
                if time.monotonic() >= next_status:
                    self._put(Update(status=self._task.status()))
                    next_status = time.monotonic() + STATUS_EVERY_S
            except CrkrError as error:
                if self._stop.is_set():
                    return
                self._put(Update(lost=error))
                more = False
            except BaseException as error:  # the thread survives any answer
                self._put(Update(lost=Internal(f"an answer cannot be read: {type(error).__name__}: {error!s:.200}")))
                more = False
            self._stop.wait(self._rest * (time.monotonic() - begun) if more else SAMPLES_EVERY_S)

    def _ask_trials(self) -> bool:
        trials, following = self._task.samples(after=self._after, limit=PAGE)
        if trials:
            self._after = trials[-1].seq
            self._put(Update(trials=tuple(trials), more=following is not None))
        return following is not None

    def _put(self, update: Update) -> None:
        """Add an update; wait while the display is behind, so that memory does not hold a long log."""
        while not self._stop.is_set():
            try:
                self._updates.put(update, timeout=0.2)
            except queue.Full:
                continue
            return
