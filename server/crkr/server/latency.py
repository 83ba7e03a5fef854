"""How long answers took lately, by verb."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, final

import numpy as np

__all__ = ["Latencies"]

_WINDOW: Final = 1024


@final
class Latencies:
    """The last thousand times of each verb. Recording is one append: any thread may."""

    def __init__(self) -> None:
        self._times: dict[str, deque[float]] = {}

    def record(self, verb: str, seconds: float) -> None:
        """Takes note of one answer."""
        times = self._times.get(verb)
        if times is None:
            times = self._times.setdefault(verb, deque(maxlen=_WINDOW))
        times.append(seconds)

    def summary(self) -> dict[str, Any]:
        """Verb -> {p50, p99} [us] and how many they are taken from."""
        found: dict[str, Any] = {}
        for verb, times in list(self._times.items()):
            kept = np.array(times.copy()) * 1e6
            if len(kept):
                p50, p99 = np.percentile(kept, [50, 99])
                found[verb] = {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "count": len(kept)}
        return found
