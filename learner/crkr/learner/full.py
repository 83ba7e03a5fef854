"""The rule that keeps everything: Cost-regularized Kernel Regression as it was before there was a filter."""

from __future__ import annotations

from typing import final

from crkr.learner.anms_batch import Indices
from crkr.learner.order import ArrivalOrder
from crkr.learner.selector import Radii, Standing
from crkr.protocol import Array

__all__ = ["Full"]


@final
class Full:
    """Every sample is active and the budget is ignored, so a step costs O(n^2) and a prediction too.

    Args:
        dimensions: Unused; the interface's.
        budget: Unused; the interface's.
    """

    def __init__(self, dimensions: int, budget: int) -> None:
        del dimensions, budget  # Unused.
        self._order = ArrivalOrder()

    @property
    def active(self) -> Indices:
        """Numbers of all samples that are not removed."""
        return self._order.first(None)

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples; all are active."""
        del Z  # Unused.
        self._order.extend(len(costs))

    def remove(self, index: int) -> None:
        """Forgets one sample."""
        self._order.remove(index)

    def recost(self, index: int, cost: float) -> None:
        """Changes nothing: costs do not matter here."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Takes these samples."""
        del Z, radii  # Unused.
        self._order = ArrivalOrder()
        self._order.extend(len(costs))

    def set_budget(self, budget: int) -> None:
        """Changes nothing: there is no budget."""

    def standing(self, index: int) -> Standing:
        """Nothing suppresses a sample."""
        del index  # Unused.
        return Standing(None, None)

    def radii(self) -> None:
        """Nothing need be kept."""
