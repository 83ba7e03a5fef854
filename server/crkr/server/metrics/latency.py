"""How requests were answered, by verb: how long it took, and what went wrong."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import Any, Final, final

import numpy as np

from crkr.protocol import ADMIN_VERBS, SERVER_VERBS, TASK_VERBS
from crkr.server.metrics.durations import Durations

__all__ = ["OTHER_VERB", "Latencies"]

OTHER_VERB: Final = "other"  # anything that is none of the protocol's verbs: clients must not make up labels
_VERBS: Final = frozenset({*SERVER_VERBS, *TASK_VERBS, *ADMIN_VERBS})


@final
class Latencies:
    """Times of answers and counts of refusals, by verb; any thread may record."""

    def __init__(self) -> None:
        self._times: dict[str, Durations] = {}
        self._refusals: Counter[tuple[str, str]] = Counter()
        self._counting = threading.Lock()

    def record(self, verb: str, seconds: float) -> None:
        """Takes note of one answer."""
        times = self._times.get(verb)
        if times is None:
            times = self._times.setdefault(verb, Durations())
        times.record(seconds)

    def refused(self, verb: str, code: str) -> None:
        """Takes note of one error reply."""
        with self._counting:
            self._refusals[verb if verb in _VERBS else OTHER_VERB, code] += 1

    def summary(self) -> dict[str, Any]:
        """Verb -> {p50, p99} [us] of the last thousand answers, and how many there were since the start."""
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
