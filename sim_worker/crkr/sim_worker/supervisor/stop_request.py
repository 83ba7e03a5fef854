"""Ctrl-C, SIGTERM and a closed terminal as a wish that a loop looks at, so that nothing is cut off in the middle."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any, Final, final

__all__ = ["StopRequest", "ctrl_c_blocked"]

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last when a terminal is closed


@final
class StopRequest:
    """While entered, remembers the first of SIGINT, SIGTERM and SIGHUP instead of acting on it; main thread only.

    `nohup` keeps its meaning: where SIGHUP is ignored, it stays so.

    Attributes:
        signal: Which one came, or None.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopRequest:
        ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        heeded = [each for each in SIGNALS if each is not signal.SIGHUP or not ignored]
        self._before = {each: signal.signal(each, self._remember) for each in heeded}
        return self

    def __exit__(self, *exception: object) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def __bool__(self) -> bool:
        return self.signal is not None

    @property
    def status(self) -> int:
        """Exit status by the shell's convention: 130 for SIGINT, 143 for SIGTERM, 129 for SIGHUP, 0 for none."""
        return 0 if self.signal is None else 128 + self.signal

    def _remember(self, number: int, frame: FrameType | None) -> None:
        del frame  # Unused.
        self.signal = self.signal or signal.Signals(number)


@contextmanager
def ctrl_c_blocked() -> Iterator[None]:
    """A process started meanwhile inherits the mask and never sees SIGINT or SIGHUP; ours are delivered afterwards.

    A terminal sends both to all processes of a command, which ends its own in order.
    """
    resource_tracker.ensure_running()  # starting it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
