"""Ctrl-C, SIGTERM and a closed terminal as a flag that a loop looks at, so that nothing is cut off half-way."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any, Final, final

__all__ = ["StopRequest"]

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # the last when a terminal is closed


@final
class StopRequest:
    """Becomes true at the first SIGINT, SIGTERM or SIGHUP while entered; main thread only.

    `nohup` keeps its meaning: where SIGHUP is ignored, it stays ignored. The flag is a plain attribute, because the
    handler runs on the main thread, which may hold an event's lock at that moment.

    Args:
        second_ends: A second SIGINT or SIGTERM ends the process at once, whatever it is doing. It has the system's own
            action rather than `KeyboardInterrupt`, which waits for a call into a library to return. A second SIGHUP is
            always ignored: shell and kernel both send one when a terminal is closed.

    Attributes:
        signal: The first signal, or None.
    """

    def __init__(self, *, second_ends: bool = False) -> None:
        self.signal: signal.Signals | None = None
        self._second_ends = second_ends
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
        if self._second_ends:
            for each in self._before:
                signal.signal(each, signal.SIG_IGN if each is signal.SIGHUP else signal.SIG_DFL)
        self.signal = self.signal or signal.Signals(number)
