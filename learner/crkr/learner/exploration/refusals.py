"""Whether a goal is executed at all, learned from the goals that were refused near by.

A Gaussian process learns 0 for executed and -2 for refused goals, and its expectation r gives P(executed) =
Phi((r + 0.5) / 0.3). Where no near goal was refused, a goal counts as executed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from crkr.learner.exploration.local_gp import LocalGP, StepKernel
from crkr.learner.exploration.outcome_scales import GOAL_SHARE
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["Refusals", "RefusedNear"]

_REFUSAL: Final = StepKernel(constant=4.0, linear=1.0, bend=4.0, reach=2.0, noise=0.1)
_REFUSED: Final = -2.0
_THRESHOLD: Final = -0.5
_WIDTH: Final = 0.3  # of the probit
_SAFE: Final = -0.05  # r above which a goal is executed without a correction


@final
@dataclass(frozen=True, slots=True, eq=False)
class Refusals:
    """The model near some points; made by `RefusedNear.model`.

    Attributes:
        risky: Points with refused goals near by.
        fit: The model there; None without any.
    """

    risky: Indices
    fit: LocalGP | None

    def executed(self, steps: Array) -> Array:
        """(b, c) log P(executed) at steps (b, c, p) from the points."""
        chances = np.zeros(steps.shape[:2])
        if self.fit is not None:
            r = self.fit.mean(steps[self.risky])[..., 0]
            chances[self.risky] = log_ndtr((r - _THRESHOLD) / _WIDTH)
        return chances

    def put_line(self, steps: Array, o: Array, J: Array) -> None:
        """Writes one more outcome, to be executed, into o (b,) and its slope J (b, p), for steps (b, p); 0 if it is."""
        if self.fit is None:
            return
        r, slope_of = self.fit.tangent(steps[self.risky])
        unsafe = r[:, 0] < _SAFE
        if unsafe.any():
            rows = self.risky[unsafe]
            o[rows], J[rows] = r[unsafe, 0] / _WIDTH, slope_of()[unsafe, 0] * (GOAL_SHARE / _WIDTH)

    def of(self, which: Indices) -> Refusals:
        """The model near some of the points."""
        if self.fit is None:
            return self
        places = np.flatnonzero(np.isin(self.risky, which))
        fit = self.fit.of(places) if len(places) else None
        return Refusals(np.searchsorted(which, self.risky[places]), fit)


@final
@dataclass(frozen=True, slots=True, eq=False)
class RefusedNear:
    """Which of the trials nearest to some points were refused.

    Attributes:
        D: (b, k, r) trials minus their point, in the metric.
        refused: (b, k).
        p: Number of the r coordinates, at the end, that are the goal's.
        former: Number of the k trials, at the end, from before the robot changed.
    """

    D: Array
    refused: NDArray[np.bool_]
    p: int
    former: int

    def model(self) -> Refusals:
        """The model near the points."""
        D, refused = self.D, self.refused
        risky = np.flatnonzero(refused.any(axis=1))
        if not len(risky):
            return Refusals(risky, None)
        if len(risky) < len(D):
            D, refused = D[risky], refused[risky]
        y = np.where(refused, _REFUSED, 0.0)[..., None]
        return Refusals(risky, LocalGP.fit(_REFUSAL, D, y, self.p, former=self.former))

    @staticmethod
    def executed(each: Sequence[RefusedNear]) -> Array:
        """(n,) log P(executed) of the goals at n points, given one by one; together they take less time."""
        chances = np.zeros(len(each))
        shapes = [(one.D.shape[1], one.p, one.former) for one in each]
        for shape in set(shapes):
            places = [place for place, own in enumerate(shapes) if own == shape]
            D, refused = (np.concatenate([getattr(each[place], name) for place in places]) for name in ("D", "refused"))
            model = RefusedNear(D, refused, *shape[1:]).model()
            chances[places] = model.executed(np.zeros((len(places), 1, shape[1])))[:, 0]
        return chances
