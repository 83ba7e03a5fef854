"""What turns a posterior of goals into the goals to execute; every way to explore stands behind this interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.draws import truncated_normal, uniforms
from crkr.protocol import Array, TaskSpec

__all__ = ["Choice", "Explorer", "GaussianExplorer"]


class Choice(NamedTuple):
    """Goals for one state, or with a leading b for a batch.

    Attributes:
        goals: (p,) or (b, p) within the bounds [units of the goal].
        corrected: () or (b,) which goals are not the plain means because of what they would lead to; None: none.
        predicted_outcome: (q,) or (b, q) [units of the outcome], NaN where it is not modelled; None: nowhere.
        predicted_outcome_sd: The same shape.
        success_probability: () or (b,), NaN where nothing is known; None: nowhere.
    """

    goals: Array
    corrected: NDArray[np.bool_] | None = None
    predicted_outcome: Array | None = None
    predicted_outcome_sd: Array | None = None
    success_probability: Array | None = None


class Explorer(Protocol):
    """Chooses goals given means and standard deviations; an immutable part of a model.

    What it returns must depend on its arguments and on what it was made from only, row by row.
    """

    @property
    def guides(self) -> bool:
        """Whether it knows where to explore although nothing has succeeded yet."""

    def best_tried(self, states: Array) -> Array:
        """Goals (p,) or (b, p) to start from in these states while nothing has succeeded; asked only if it guides."""

    def prepare(self, trials: int = 0) -> bool:
        """Process at most this many trials that answers wait for; True once all are done. For one thread at a time."""

    @property
    def searched(self) -> int:
        """How many stored trials each state is compared with: what an answer costs beyond its regression grows so."""

    def best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        """Goals to execute where nothing is to be tried out.

        Args:
            states: (d,) or (b, d) [units of the state].
            means: (p,) or (b, p), not clipped [units of the goal].
            sigmas: Their standard deviations.
        """

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Goals to try, a pure function of the trial ids besides."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class GaussianExplorer:
    """The paper's: the mean, or an independent normal draw around it  [Cardoso2017, alg. 1].

    Attributes:
        seed: Seed of the task's draws.
        low: (p,) lowest goals allowed [units of the goal].
        high: (p,) highest goals allowed [units of the goal].
    """

    seed: int
    low: Array
    high: Array

    @classmethod
    def of(cls, spec: TaskSpec) -> GaussianExplorer:
        """That of a task."""
        return cls(spec.seed, *spec.bounds)

    @property
    def guides(self) -> bool:
        """It does not."""
        return False

    def best_tried(self, states: Array) -> Array:
        """The middle of the bounds."""
        return np.broadcast_to(self.low / 2 + self.high / 2, (*states.shape[:-1], len(self.low))).copy()

    def prepare(self, trials: int = 0) -> bool:
        """Nothing is left."""
        del trials  # Unused; the interface's.
        return True

    @property
    def searched(self) -> int:
        """None."""
        return 0

    def best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        """The means, clipped to the bounds."""
        del states, sigmas  # Unused; the interface's.
        goals = np.maximum(means, self.low)
        return Choice(np.minimum(goals, self.high, out=goals))

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Draws from N(mean, sigma^2) truncated to the bounds (the paper's N(0, sigma^2) is a slip)."""
        del states  # Unused; the interface's.
        u = uniforms(self.seed, ids, len(self.low)).reshape(means.shape)
        return Choice(truncated_normal(means, sigmas, self.low, self.high, u))
