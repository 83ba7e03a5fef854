"""How long one kind of work takes: noted in passing, made into numbers only when somebody asks."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Array

__all__ = ["BOUNDS_S", "Durations", "Histogram"]

# Upper bounds of a histogram's buckets, inclusive [s]; one more bucket holds all that took longer.
BOUNDS_S: Final = (
    *(1e-6 * bound for bound in (50, 100, 150, 200, 300, 500)),
    *(1e-3 * bound for bound in (1, 2, 5, 10, 20, 50, 100, 200, 500)),
    *(1.0, 2.0, 5.0, 10.0),
)
_WINDOW: Final = 1024  # that `recent` looks back


@final
@dataclass(frozen=True, slots=True)
class Histogram:
    """Everything since the start.

    Attributes:
        counts: How many took at most each of `BOUNDS_S`, then how many there were in all.
        total_s: Their sum [s].
    """

    counts: Sequence[int]
    total_s: float


@final
class Durations:
    """Times of one kind of work since the start. Recording is one append, without a lock: any thread may.

    The oldest are counted into the histogram when so many have come that `recent` needs them no more.
    """

    __slots__ = ("_counted", "_counting", "_times", "_total_s")

    def __init__(self) -> None:
        self._times: deque[float] = deque()
        self._counting = threading.Lock()
        self._counted: NDArray[np.int64] = np.zeros(len(BOUNDS_S) + 1, dtype=np.int64)
        self._total_s = 0.0

    def record(self, seconds: float) -> None:
        """Takes note of one."""
        self._times.append(seconds)
        if len(self._times) >= 2 * _WINDOW and self._counting.acquire(blocking=False):
            try:
                self._count_oldest()
            finally:
                self._counting.release()

    @contextmanager
    def timing(self) -> Iterator[None]:
        """Takes note of how long the block takes, unless it raises."""
        started = time.perf_counter()
        yield
        self.record(time.perf_counter() - started)

    def recent(self) -> Array:
        """The last times [s], a thousand at most."""
        return np.array(self._times.copy())[-_WINDOW:]

    @property
    def count(self) -> int:
        """How many there were."""
        with self._counting:
            return int(self._counted.sum()) + len(self._times)

    def histogram(self) -> Histogram:
        """How they are distributed."""
        with self._counting:  # so that none is between the two
            times = np.array(self._times.copy())
            counts = np.cumsum(self._counted + _tally(times))
            return Histogram(counts.tolist(), self._total_s + float(times.sum()))

    def _count_oldest(self) -> None:
        while len(self._times) >= 2 * _WINDOW:  # or another thread was here just before
            old = np.array([self._times.popleft() for _ in range(_WINDOW)])
            self._counted += _tally(old)
            self._total_s += float(old.sum())


def _tally(times: Array) -> NDArray[np.int64]:
    return np.bincount(np.searchsorted(BOUNDS_S, times), minlength=len(BOUNDS_S) + 1)
