"""The rule that stops learning when the budget is full: what the filter is compared with."""

from __future__ import annotations

from typing import final

from crkr.learner.anms_batch import Indices
from crkr.learner.order import ArrivalOrder
from crkr.learner.selector import Radii, Standing
from crkr.protocol import Array

__all__ = ["Freeze"]


@final
class Freeze:
    """The first k samples are active; later ones only fill the places of removed ones.

    Args:
        dimensions: Unused; the interface's.
        budget: k, the largest number of active samples.
    """

    def __init__(self, dimensions: int, budget: int) -> None:
        del dimensions  # Unused.
        self._budget = budget
        self._order = ArrivalOrder()

    @property
    def active(self) -> Indices:
        """Numbers of the oldest k samples that are not removed."""
        return self._order.first(self._budget)

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples; they are active while there is room."""
        del Z  # Unused.
        self._order.extend(len(costs))

    def remove(self, index: int) -> None:
        """Forgets one sample; the next oldest takes its place."""
        self._order.remove(index)

    def recost(self, index: int, cost: float) -> None:
        """Changes nothing: costs do not matter here."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Takes these samples."""
        del Z, radii  # Unused.
        self._order = ArrivalOrder()
        self._order.extend(len(costs))

    def set_budget(self, budget: int) -> None:
        """Makes room for more, or lets the youngest go."""
        self._budget = budget

    def standing(self, index: int) -> Standing:
        """Nothing suppresses a sample; it came early enough or too late."""
        del index  # Unused.
        return Standing(None, None)

    def radii(self) -> None:
        """Nothing need be kept."""
