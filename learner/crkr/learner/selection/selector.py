"""The interface of a rule that chooses the active samples."""

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
    """Why a sample is active or not.

    Attributes:
        suppressor: Index of the better sample that sets its radius; None without one.
        radius: Distance to the suppressor in creation length-scales; None where it is infinite or unknown.
    """

    suppressor: int | None
    radius: float | None


@final
@dataclass(frozen=True, slots=True, eq=False)
class Radii:
    """Radii that a selector may store to restart quickly.

    Attributes:
        squared: (n,) squared radii of the samples that are not removed, oldest first.
        suppressor: (n,) positions in the same order; -1 for the best.
    """

    squared: Array
    suppressor: Indices


class Selector(Protocol):
    """Chooses the active samples.

    Samples are numbered from 0 in order of arrival, and keep their numbers until `rebuild`. States are standardised
    by the length-scales the task was created with. A selector must depend on the samples and their order only, so that
    a replayed log gives the same active set.
    """

    @property
    def active(self) -> Indices:
        """Numbers of the active samples, ascending, read-only; the same object while nothing changes."""

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples (n, d) with costs (n,)."""

    def remove(self, indices: Indices | int) -> None:
        """Removes stored samples; their numbers are not used again."""

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Changes the costs of samples, each named once; ages stay."""

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Replaces all samples by these and renumbers them; `radii` are theirs, if known."""

    def set_budget(self, budget: int) -> None:
        """Changes the number of samples that may be active."""

    def standing(self, index: int) -> Standing:
        """Status of one sample."""

    def radii(self) -> Radii | None:
        """Radii that make the next `rebuild` quick; None if there are none."""


SelectorFactory = Callable[[int, int], Selector]
"""Makes a selector for states of d dimensions and a budget."""
