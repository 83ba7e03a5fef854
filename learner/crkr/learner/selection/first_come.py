"""The rules that look at nothing but the order of arrival: what the filter is compared with."""

from __future__ import annotations

from typing import final

from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.arrival_order import ArrivalOrder
from crkr.learner.selection.selector import Radii, Standing
from crkr.protocol import MOST_KEPT, Array

__all__ = ["FirstCome"]


@final
class FirstCome:
    """The first `budget` samples are active; later ones only fill the places of removed ones. Make it by name.

    `freeze` stops learning when the budget is full. `full` keeps everything, Cost-regularized Kernel Regression as it
    was before there was a filter: a step costs O(n^2), and a prediction too. Hence it stops at `MOST_KEPT` samples,
    whatever the budget.
    """

    def __init__(self, budget: int, bounded: bool = True) -> None:
        self._budget, self._bounded = budget, bounded
        self._order = ArrivalOrder()

    @classmethod
    def freeze(cls, dimensions: int, budget: int) -> FirstCome:
        """The oldest `budget` samples; their states, of `dimensions`, do not matter."""
        del dimensions  # Unused; the interface's.
        return cls(budget)

    @classmethod
    def full(cls, dimensions: int, budget: int) -> FirstCome:
        """All samples, up to `MOST_KEPT`."""
        del dimensions, budget  # Unused; the interface's.
        return cls(MOST_KEPT, bounded=False)

    @property
    def active(self) -> Indices:
        """Numbers of the oldest samples that are not removed."""
        return self._order.first(self._budget)

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples; they are active while there is room."""
        del Z  # Unused.
        self._order.extend(len(costs))

    def remove(self, indices: Indices | int) -> None:
        """Forgets samples; the next oldest take their places."""
        self._order.remove(indices)

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Changes nothing: costs do not matter here."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Takes these samples."""
        del Z, radii  # Unused.
        self._order = ArrivalOrder()
        self._order.extend(len(costs))

    def set_budget(self, budget: int) -> None:
        """Makes room for more, or lets the youngest go, where there is a budget at all."""
        if self._bounded:
            self._budget = budget

    def standing(self, index: int) -> Standing:
        """Nothing suppresses a sample; it came early enough or too late."""
        del index  # Unused.
        return Standing(None, None)

    def radii(self) -> None:
        """Nothing need be kept."""
