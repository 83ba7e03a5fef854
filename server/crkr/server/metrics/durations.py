"""How long work takes, and how requests end."""

from __future__ import annotations

import threading
import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Final, final

import numpy as np

from crkr.protocol import ADMIN_VERBS, SERVER_VERBS, TASK_VERBS, Array

__all__ = ["BOUNDS_S", "OTHER_VERB", "Durations", "Histogram", "Latencies"]

# Upper bounds of a histogram's buckets, inclusive [s]; one more bucket holds all that took longer.
BOUNDS_S: Final = (
    *(1e-6 * bound for bound in (50, 100, 150, 200, 300, 500)),
    *(1e-3 * bound for bound in (1, 2, 5, 10, 20, 50, 100, 200, 500)),
    *(1.0, 2.0, 5.0, 10.0),
)
OTHER_VERB: Final = "other"  # stands for unknown verbs, so that clients cannot make up labels
_VERBS: Final = frozenset({*SERVER_VERBS, *TASK_VERBS, *ADMIN_VERBS})
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
    """Times of one kind of work since the start; any thread may record."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_WINDOW)
        self._counts = [0] * (len(BOUNDS_S) + 1)
        self._total_s = 0.0
        self._changing = threading.Lock()

    def record(self, seconds: float) -> None:
        """Record one time."""
        bucket = bisect_left(BOUNDS_S, seconds)
        with self._changing:
            self._recent.append(seconds)
            self._counts[bucket] += 1
            self._total_s += seconds

    @contextmanager
    def timing(self) -> Iterator[None]:
        """Record the time of a block, unless it raises."""
        started = time.perf_counter()
        yield
        self.record(time.perf_counter() - started)

    def recent(self) -> Array:
        """The latest times [s], at most 1024."""
        with self._changing:
            return np.array(self._recent)

    @property
    def count(self) -> int:
        """Number of times recorded."""
        return self.histogram().counts[-1]

    def histogram(self) -> Histogram:
        """Cumulative counts and sum of all times."""
        with self._changing:
            return Histogram(list(accumulate(self._counts)), self._total_s)


@final
class Latencies:
    """Times of answers and counts of refusals, by verb; any thread may record."""

    def __init__(self) -> None:
        self._times: dict[str, Durations] = {}
        self._refusals: Counter[tuple[str, str]] = Counter()
        self._counting = threading.Lock()

    def record(self, verb: str, seconds: float) -> None:
        """Record one answer."""
        times = self._times.get(verb)
        if times is None:
            times = self._times.setdefault(verb, Durations())
        times.record(seconds)

    def refused(self, verb: str, code: str) -> None:
        """Count one error reply."""
        with self._counting:
            self._refusals[verb if verb in _VERBS else OTHER_VERB, code] += 1

    def summary(self) -> dict[str, Any]:
        """Verb -> p50 and p99 [us] of the last 1024 answers, and the count since the start."""
        found: dict[str, Any] = {}
        for verb, times in list(self._times.items()):
            recent = times.recent() * 1e6
            if len(recent):
                p50, p99 = np.percentile(recent, [50, 99])
                found[verb] = {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "count": times.count}
        return found

    def answers(self) -> Mapping[str, Durations]:
        """Verb -> the times of its answers."""
        return dict(list(self._times.items()))

    def refusals(self) -> Mapping[tuple[str, str], int]:
        """(verb, error code) -> how many error replies."""
        with self._counting:
            return dict(self._refusals)
