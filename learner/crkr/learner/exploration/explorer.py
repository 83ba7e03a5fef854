"""The interface of exploration: from a posterior over goals to the goals to execute."""

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
        corrected: () or (b,) goals that differ from the means because of the expected outcome; None: none.
        predicted_outcome: (q,) or (b, q) [units of the outcome], NaN where not modelled; None: not modelled at all.
        predicted_outcome_sd: The same shape.
        success_probability: () or (b,), NaN if unknown; None: not modelled at all.
    """

    goals: Array
    corrected: NDArray[np.bool_] | None = None
    predicted_outcome: Array | None = None
    predicted_outcome_sd: Array | None = None
    success_probability: Array | None = None


class Explorer(Protocol):
    """Chooses goals given means and standard deviations; an immutable part of a model.

    Its results must depend only on its arguments and its state, row by row.
    """

    @property
    def guides(self) -> bool:
        """Whether it can propose goals before the first success."""

    def best_tried(self, states: Array) -> Array:
        """Goals (p,) or (b, p) to start from in these states before the first success; called only if it guides."""

    def prepare(self, trials: int = 0) -> bool:
        """Process at most this many of the trials that answers need; True once all are done. Not thread-safe."""

    @property
    def searched(self) -> int:
        """Stored trials compared per query state. Prediction time grows linearly with it."""

    def best(self, states: Array, means: Array, sigmas: Array) -> Choice:
        """Best known goals, without exploration.

        Args:
            states: (d,) or (b, d) [units of the state].
            means: (p,) or (b, p), not clipped [units of the goal].
            sigmas: Their standard deviations.
        """

    def draw(self, states: Array, means: Array, sigmas: Array, ids: Sequence[UUID]) -> Choice:
        """Goals to try; also a pure function of the trial ids."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class GaussianExplorer:
    """The paper's exploration: the mean, or an independent normal draw around it  [Cardoso2017, alg. 1].

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
        """The explorer of a task."""
        return cls(spec.seed, *spec.bounds)

    @property
    def guides(self) -> bool:
        """False: it needs successes."""
        return False

    def best_tried(self, states: Array) -> Array:
        """The middle of the bounds."""
        return np.broadcast_to(self.low / 2 + self.high / 2, (*states.shape[:-1], len(self.low))).copy()

    def prepare(self, trials: int = 0) -> bool:
        """True: there is nothing to process."""
        del trials  # Unused; the interface's.
        return True

    @property
    def searched(self) -> int:
        """0: it compares no trials."""
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
