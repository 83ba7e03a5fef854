"""Units of the outcome model: coordinates in which one step matters about equally in every direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.kernel import Kernel
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array, TaskSpec

__all__ = ["GOAL_SHARE", "OutcomeScales"]

GOAL_SHARE: Final = 0.5  # a goal's scale counts as half a length-scale of the state
_FARTHEST: Final = 1e50  # like standardised states: squares and products stay finite
_SIDES: Final = {"equal": 0.0, "at_least": 1.0, "at_most": -1.0}
_LARGEST: Final = 1e6  # tolerances; larger misses count as this one


@final
@dataclass(frozen=True, slots=True, eq=False)
class OutcomeScales:
    """Scales of states, goals and outcomes, from the task as created. Make it with `of`.

    Attributes:
        metric: Standardises states by the creation length-scales, or by a quarter of the box where that is shorter:
            the kernel's may be long, but a line is fitted to near trials.
        middle: (p,) midpoints of the goal bounds [units of the goal].
        scales: (p,) scales of the goals [units of the goal].
        low: (p,) lowest goals in scaled form.
        high: (p,) highest goals in scaled form.
        target: (q,) [units of the outcome].
        tolerance: (q,) [units of the outcome].
        groups: Entries of each group that is observed together.
        one_sided: (q,) +1 for entries that may exceed their target, -1 for entries that may fall short of it, else 0.
    """

    metric: Kernel
    middle: Array
    scales: Array
    low: Array
    high: Array
    target: Array
    tolerance: Array
    groups: tuple[Indices, ...]
    one_sided: Array

    @classmethod
    def of(cls, spec: TaskSpec) -> OutcomeScales:
        """The scales of a task."""
        low, high = spec.bounds
        quarters = [axis.high / 4 - axis.low / 4 for axis in spec.state]
        middle = low / 2 + high / 2
        names = [entry.group for entry in spec.outcome]
        return cls(
            metric=Kernel(spec.centres, np.minimum(spec.lengthscales, quarters), 1.0),
            middle=middle,
            scales=spec.scales,
            low=_bounded((low - middle) / spec.scales),
            high=_bounded((high - middle) / spec.scales),
            target=np.array([entry.target for entry in spec.outcome]),
            tolerance=np.array([entry.tolerance for entry in spec.outcome]),
            one_sided=np.array([_SIDES[entry.aim] for entry in spec.outcome]),
            groups=tuple(np.flatnonzero([name == one for name in names]) for one in dict.fromkeys(names)),
        )

    def scaled(self, goals: Array) -> Array:
        """Goals (..., p) in scales from the midpoint, clipped to the bounds."""
        return self.within((goals - self.middle) / self.scales)

    def within(self, scaled: Array) -> Array:
        """Scaled goals (..., p), clipped to the bounds."""
        return np.minimum(np.maximum(scaled, self.low), self.high)

    def points(self, states: Array, goals: Array) -> Array:
        """Trials (n, d + p) in the metric for distances, from states (n, d) and goals (n, p)."""
        return np.concatenate([self.metric.standardise(states), GOAL_SHARE * self.scaled(goals)], axis=-1)

    def deviations(self, outcomes: Array) -> Array:
        """Outcomes (n, q) in tolerances from the target; NaN stays."""
        with np.errstate(over="ignore"):
            return np.clip((outcomes - self.target) / self.tolerance, -_LARGEST, _LARGEST)

    def observed(self, outcomes: Array) -> NDArray[np.bool_]:
        """(n, groups) whether all entries of each group of outcomes (n, q) were observed."""
        seen = ~np.isnan(outcomes)
        return np.stack([seen[:, entries].all(axis=1) for entries in self.groups], axis=1)


def _bounded(array: Array) -> Array:
    return np.clip(array, -_FARTHEST, _FARTHEST)
