"""What is to be believed of an answer, whoever gave it: goals that the task can have, receipts for what was sent."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import TypeAlias, final

import numpy as np

from crkr.protocol import Array, CrkrError, Internal, Invalid, Prediction, Receipt, TaskSpec

__all__ = ["Belief", "Goals", "check_bounds", "check_receipt"]

_Look: TypeAlias = Callable[[float | None], tuple[TaskSpec, bool]]  # asks the server for a task's specification


@final
class Goals:
    """What goals a task can have.

    Attributes:
        spec: The task's specification.
    """

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self._low, self._high = spec.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()

    def check(self, answer: Prediction, ids: Sequence[bytes]) -> Prediction:
        """The answer, if a robot may try it.

        Args:
            answer: As it was read.
            ids: Those that were asked for, 16 bytes each.

        Raises:
            Internal: Goals outside the bounds or not finite; `details["prediction"]` has them.
            Invalid: Another shape, means or sigmas that are not finite, other ids.
        """
        shape = (*answer.states.shape[:-1], len(self._lows))
        if not answer.goals.shape == answer.means.shape == answer.sigmas.shape == shape:
            raise Invalid(f"goals, means and sigmas must have the shape {shape}")
        if not (self._has_one(answer) if len(shape) == 1 else self._has_all(answer)):
            raise self._complaint(answer)
        if [one.bytes for one in answer.trial_ids] != ids:
            raise Invalid("it is about other trials than those that were asked about")
        return answer

    def _has_one(self, answer: Prediction) -> bool:
        """For one state, without numpy's price for few numbers."""
        goals = answer.goals.tolist()
        if not (all(map(operator.le, self._lows, goals)) and all(map(operator.le, goals, self._highs))):
            return False
        total = sum(answer.means.tolist()) + sum(answer.sigmas.tolist())
        return math.isfinite(total) or self._has_all(answer)  # a sum of finite numbers may overflow

    def _has_all(self, answer: Prediction) -> bool:
        within = ((answer.goals >= self._low) & (answer.goals <= self._high)).all()
        return bool(within and np.isfinite(answer.means).all() and np.isfinite(answer.sigmas).all())

    def _complaint(self, answer: Prediction) -> CrkrError:
        goals = answer.goals
        wrong = np.argwhere(~((goals >= self._low) & (goals <= self._high)))
        if not len(wrong):
            return Invalid("its means and sigmas must be finite")
        axis, given = self.spec.goal[wrong[0][-1]], goals[tuple(wrong[0])]
        return Internal(
            f"the server proposes a goal that is not to be tried: {axis.name!r} must be in [{axis.low}, {axis.high}] "
            f"{axis.unit}; got {given}",
            details={"prediction": answer},
        )


@final
class Belief:
    """A task's answers, checked against the bounds that it is known to have."""

    def __init__(self) -> None:
        self._known: Goals | None = None

    def check(self, spec: TaskSpec, look: _Look, answer: Prediction, ids: Sequence[bytes]) -> Prediction:
        """As `Goals.check`; before it is refused, the server is asked whether it came back with other data."""
        known = self._known
        if known is None or known.spec is not spec:
            known = self._known = Goals(spec)
        try:
            return known.check(answer, ids)
        except (Internal, Invalid):
            return Goals(look(None)[0]).check(answer, ids)


def check_bounds(known: TaskSpec | None, look: _Look, low: Array, high: Array) -> None:
    """Raises `Invalid` where the bounds of a model are others than those of the specification, if it is known."""
    if known is not None and not _are(low, high, known) and not _are(low, high, look(None)[0]):
        raise Invalid("the bounds of its goals are not the task's")


def _are(low: Array, high: Array, spec: TaskSpec) -> bool:
    return all(map(np.array_equal, (low, high), spec.bounds))


def check_receipt(receipt: Receipt, count: int) -> Receipt:
    """The receipt of `count` trials; raises `Invalid` where it is one of others."""
    if receipt.accepted + receipt.duplicates != count or len(receipt.seqs) != count:
        raise Invalid(f"it acknowledges {receipt.accepted + receipt.duplicates} trials of {count}")
    return receipt
