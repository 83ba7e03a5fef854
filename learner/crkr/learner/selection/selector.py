"""What a rule for choosing the active samples must offer; every rival stands behind this interface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, final

from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["Radii", "Selector", "SelectorFactory", "Standing"]


@final
@dataclass(frozen=True, slots=True)
class Standing:
    """Why a sample is active, or is not.

    Attributes:
        suppressor: Index of the better sample that sets its radius; None where there is none.
        radius: Distance to the suppressor in creation length-scales; None where it is infinite or unknown.
    """

    suppressor: int | None
    radius: float | None


@final
@dataclass(frozen=True, slots=True, eq=False)
class Radii:
    """What a selector may keep to restart quickly; never truth.

    Attributes:
        squared: (n,) squared radii of the samples that are not removed, oldest first.
        suppressor: (n,) positions in the same order; -1 for the best.
    """

    squared: Array
    suppressor: Indices


class Selector(Protocol):
    """Chooses the active samples among all it was told of.

    Samples are numbered from 0 in the order they came, and keep their numbers until `rebuild`. States are standardised
    by the length-scales the task was created with. A selector must depend on the samples and their order only, so that
    a replayed log gives the same active set.
    """

    @property
    def active(self) -> Indices:
        """Numbers of the active samples, ascending, read-only; the same object while nothing changes."""

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples (n, d) with costs (n,)."""

    def remove(self, indices: Indices | int) -> None:
        """Forgets samples, which must be there; their numbers are not used again."""

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Changes the costs of samples, each named once; their age stays."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Forgets everything and takes these samples, numbered anew; `radii` are theirs if known."""

    def set_budget(self, budget: int) -> None:
        """Changes how many samples may be active."""

    def standing(self, index: int) -> Standing:
        """Where one sample stands."""

    def radii(self) -> Radii | None:
        """What makes the next `rebuild` quick, where there is such a thing."""


SelectorFactory = Callable[[int, int], Selector]
"""Makes a selector for states of d dimensions and a budget."""
