"""Durations and results of requests: histograms for Prometheus, and the latest times for `status`.

Recording an answer costs one append. The rest is computed when a metric is read, or once in a thousand times.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray
from prometheus_client import Counter, Metric
from prometheus_client.core import CounterMetricFamily, HistogramMetricFamily

from crkr.protocol import ADMIN_VERBS, SERVER_VERBS, TASK_VERBS, Array

__all__ = ["BOUNDS_S", "OTHER_VERB", "Durations", "Latencies"]

# Upper bounds of the histogram's buckets, inclusive [s]; one more bucket has the rest.
BOUNDS_S: Final = (
    *(5e-5, 1e-4, 1.5e-4, 2e-4, 3e-4, 5e-4),
    *(0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5),
    *(1.0, 2.0, 5.0, 10.0),
)
OTHER_VERB: Final = "other"  # stands for unknown verbs, so that clients cannot make up labels
_VERBS: Final = frozenset({*SERVER_VERBS, *TASK_VERBS, *ADMIN_VERBS})
_WINDOW: Final = 1024  # times that `recent` covers
_LABELS: Final = [*map(str, BOUNDS_S), "+Inf"]


@final
class Durations:
    """Times of one kind of work since the start; any thread may record.

    Args:
        name: The metric's name, if it has its own.
        text: The metric's description.
    """

    __slots__ = ("_counted", "_counting", "_name", "_text", "_times", "_total_s")

    def __init__(self, name: str = "", text: str = "") -> None:
        self._name, self._text = name, text
        self._times: deque[float] = deque()  # the latest ones; those before are in the counts only
        self._counted: NDArray[np.int64] = np.zeros(len(_LABELS), dtype=np.int64)
        self._total_s = 0.0
        self._counting = threading.Lock()

    def record(self, seconds: float) -> None:
        """Record one time."""
        self._times.append(seconds)
        if len(self._times) >= 2 * _WINDOW and self._counting.acquire(blocking=False):
            try:
                oldest = np.array([self._times.popleft() for _ in range(_WINDOW)])
                self._counted += _tally(oldest)
                self._total_s += float(oldest.sum())
            finally:
                self._counting.release()

    @contextmanager
    def timing(self) -> Iterator[None]:
        """Record the time of a block, unless it raises."""
        started = time.perf_counter()
        yield
        self.record(time.perf_counter() - started)

    def recent(self) -> Array:
        """The latest times [s], at most 1024."""
        return np.array(self._times.copy())[-_WINDOW:]

    def counts(self) -> tuple[list[int], float]:
        """Numbers of times up to each of `BOUNDS_S`, then of all; and their sum [s]."""
        with self._counting:  # so that no time is missed in between
            times = np.array(self._times.copy())
            found = np.cumsum(self._counted + _tally(times))
            return found.tolist(), self._total_s + float(times.sum())

    def add_to(self, metric: HistogramMetricFamily, labels: list[str]) -> int:
        """Add all times to a metric; returns how many."""
        found, total_s = self.counts()
        metric.add_metric(labels, list(zip(_LABELS, found, strict=True)), total_s)
        return found[-1]

    def collect(self) -> list[Metric]:
        """The metric of all times."""
        metric = HistogramMetricFamily(self._name, self._text, labels=[])
        self.add_to(metric, [])
        return [metric]


@final
class Latencies:
    """Times of answers and counts of requests, by verb; any thread may record."""

    def __init__(self) -> None:
        self._refused = Counter("crkr_requests", "Requests by outcome.", ["verb", "code"], registry=None)
        self._times: dict[str, Durations] = {}

    def record(self, verb: str, seconds: float) -> None:
        """Record one answer."""
        times = self._times.get(verb)
        if times is None:
            times = self._times.setdefault(verb, Durations())
        times.record(seconds)

    def refused(self, verb: str, code: str) -> None:
        """Count one error reply."""
        self._refused.labels(verb if verb in _VERBS else OTHER_VERB, code).inc()

    def summary(self) -> dict[str, Any]:
        """Verb -> p50 and p99 [us] of the last 1024 answers, and the count since the start."""
        found: dict[str, Any] = {}
        for verb, times in list(self._times.items()):
            recent = times.recent() * 1e6
            if len(recent):
                p50, p99 = np.percentile(recent, [50, 99])
                count = times.counts()[0][-1]
                found[verb] = {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "count": count}
        return found

    def collect(self) -> list[Metric]:
        """The metrics of all requests."""
        text = "From taking a request in to its answer, errors aside."
        took = HistogramMetricFamily("crkr_request_duration_seconds", text, labels=["verb"])
        ended = CounterMetricFamily("crkr_requests", "Requests by outcome.", labels=["verb", "code"])
        for verb, times in list(self._times.items()):
            ended.add_metric([verb, "OK"], times.add_to(took, [verb]))
        [refused] = self._refused.collect()
        ended.samples += [one for one in refused.samples if one.name == "crkr_requests_total"]
        return [ended, took]


def _tally(times: Array) -> NDArray[np.int64]:
    """Number of times in each bucket."""
    return np.bincount(np.searchsorted(BOUNDS_S, times), minlength=len(_LABELS))
