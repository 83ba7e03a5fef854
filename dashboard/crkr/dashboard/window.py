"""Means over the newest training trials."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from typing import final

from crkr.client.tally import Tally

__all__ = ["Window"]


@final
class Window:
    """Costs, outcomes and reasons of the newest `size` trials; adding one costs the same however many there were.

    Attributes:
        reasons: How often each reason occurs in it.
    """

    def __init__(self, size: int) -> None:
        self._entries: deque[tuple[float | None, Mapping[str, bool], str]] = deque()
        self._size = size
        self._tally = Tally()
        self.reasons: Counter[str] = Counter()

    def add(self, cost: float | None, outcomes: Mapping[str, bool], reason: str) -> None:
        """Takes a trial in; the oldest falls out of a full window."""
        if len(self._entries) == self._size:
            _, met, gone = self._entries.popleft()
            self._tally.remove(met)
            self.reasons.subtract([gone])
        self._entries.append((cost, outcomes, reason))
        self._tally.add(outcomes)
        self.reasons.update([reason])

    def __len__(self) -> int:
        return len(self._entries)

    def rate(self, criterion: str) -> float | None:
        """Share that met the criterion of the trials that were judged by it, or None without any."""
        return self._tally.rate(criterion) if self._tally.judged[criterion] else None

    def share(self, reason: str) -> float:
        """Share of trials that ended so."""
        return self.reasons[reason] / len(self._entries) if self._entries else 0.0

    def mean_cost(self) -> float | None:
        """Mean cost of those that have one."""
        costs = [cost for cost, _, _ in self._entries if cost is not None]
        return sum(costs) / len(costs) if costs else None
