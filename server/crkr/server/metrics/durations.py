"""How long work takes and how requests end: counted for Prometheus, and the latest times for `status`."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, final

import numpy as np
from prometheus_client import Counter, Histogram, Metric

from crkr.protocol import ADMIN_VERBS, SERVER_VERBS, TASK_VERBS, Array

__all__ = ["BOUNDS_S", "OTHER_VERB", "Durations", "Latencies"]

# Upper bounds of a histogram's buckets, inclusive [s]; one more bucket holds all that took longer.
BOUNDS_S: Final = (
    *(5e-5, 1e-4, 1.5e-4, 2e-4, 3e-4, 5e-4),
    *(0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5),
    *(1.0, 2.0, 5.0, 10.0),
)
OTHER_VERB: Final = "other"  # stands for unknown verbs, so that clients cannot make up labels
_VERBS: Final = frozenset({*SERVER_VERBS, *TASK_VERBS, *ADMIN_VERBS})
_WINDOW: Final = 1024  # that `recent` looks back


@final
class Durations:
    """Times of one kind of work since the start; any thread may record.

    Args:
        histogram: Counts them all; of one label where there are several.
    """

    __slots__ = ("_histogram", "_recent")

    def __init__(self, histogram: Histogram) -> None:
        self._histogram = histogram
        self._recent: deque[float] = deque(maxlen=_WINDOW)

    @classmethod
    def named(cls, name: str, text: str) -> Durations:
        """Times with a metric of their own."""
        return cls(Histogram(name, text, buckets=BOUNDS_S, registry=None))

    def record(self, seconds: float) -> None:
        """Record one time."""
        self._recent.append(seconds)
        self._histogram.observe(seconds)

    @contextmanager
    def timing(self) -> Iterator[None]:
        """Record the time of a block, unless it raises."""
        started = time.perf_counter()
        yield
        self.record(time.perf_counter() - started)

    def recent(self) -> Array:
        """The latest times [s], at most 1024."""
        return np.array(self._recent.copy())

    def collect(self) -> list[Metric]:
        """The metric of all times."""
        return list(self._histogram.collect())


@final
class Latencies:
    """Times of answers and counts of requests, by verb; any thread may record."""

    def __init__(self) -> None:
        text = "From taking a request in to its answer, errors aside."
        self._took = Histogram("crkr_request_duration_seconds", text, ["verb"], buckets=BOUNDS_S, registry=None)
        self._ended = Counter("crkr_requests", "Requests by outcome.", ["verb", "code"], registry=None)
        self._times: dict[str, tuple[Durations, Counter]] = {}

    def record(self, verb: str, seconds: float) -> None:
        """Record one answer."""
        found = self._times.get(verb)
        if found is None:
            made = Durations(self._took.labels(verb)), self._ended.labels(verb, "OK")
            found = self._times.setdefault(verb, made)
        times, answered = found
        times.record(seconds)
        answered.inc()

    def refused(self, verb: str, code: str) -> None:
        """Count one error reply."""
        self._ended.labels(verb if verb in _VERBS else OTHER_VERB, code).inc()

    def summary(self) -> dict[str, Any]:
        """Verb -> p50 and p99 [us] of the last 1024 answers, and the count since the start."""
        [ended] = self._ended.collect()
        totals = [one for one in ended.samples if one.name == "crkr_requests_total" and one.labels["code"] == "OK"]
        counts = {one.labels["verb"]: int(one.value) for one in totals}
        found: dict[str, Any] = {}
        for verb, (times, _) in list(self._times.items()):
            recent = times.recent() * 1e6
            if len(recent):
                p50, p99 = np.percentile(recent, [50, 99])
                found[verb] = {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "count": counts[verb]}
        return found

    def collect(self) -> list[Metric]:
        """The metrics of all requests."""
        return [*self._ended.collect(), *self._took.collect()]
