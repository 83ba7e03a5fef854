"""Checks of times that a program gives, and of answers: goals within the task's bounds, receipts for what was sent."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, TypeAlias, final
from uuid import UUID

import numpy as np

from crkr.protocol import Array, CrkrError, Internal, Invalid, Prediction, Receipt, TaskSpec, array_from_wire
from crkr.protocol.codec import MAX_DEPTH

__all__ = ["AnswerCheck", "GoalCheck", "answer_to", "check_bounds", "check_receipt", "plain", "positive"]

_Look: TypeAlias = Callable[[float | None], tuple[TaskSpec, bool]]  # asks the server for a task's specification


def positive(timeout_s: float) -> float:
    """The time [s] as a float; raises `Invalid` for one that is not positive and finite."""
    if not isinstance(timeout_s, int | float) or not 0 < timeout_s < float("inf"):
        raise Invalid(f"timeout_s must be a positive number of seconds; got {timeout_s!r}")
    return float(timeout_s)


@final
class answer_to:  # noqa: N801 - it reads as a phrase, `with answer_to(verb):`
    """Turns an error in decoding an answer into `Internal`, since the server is wrong, not the caller."""

    __slots__ = ("_verb",)

    def __init__(self, verb: str) -> None:
        self._verb = verb

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if isinstance(error, Invalid | TypeError | ValueError | KeyError | AttributeError):
            raise Internal(f"the server's answer to {self._verb} cannot be read: {error}") from error


def plain(value: Any, depth: int = MAX_DEPTH) -> Any:
    """A decoded message, with arrays for its array maps and UUIDs for its ids, at every level.

    Raises:
        Invalid: An array map whose bytes and shape disagree; more than `depth` maps and lists in each other.
    """
    if depth < 0:
        raise Invalid(f"a message is nested more than {MAX_DEPTH} deep")
    if isinstance(value, Mapping):
        if value.keys() >= {"shape", "dtype", "data"}:
            return array_from_wire(value, "array")
        return {key: plain(entry, depth - 1) for key, entry in value.items()}
    if isinstance(value, list):
        return [plain(entry, depth - 1) for entry in value]
    return UUID(bytes=value) if isinstance(value, bytes) and len(value) == 16 else value


@final
class GoalCheck:
    """Checks that a task can have the goals of an answer."""

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self._low, self._high = spec.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()

    def check(self, answer: Prediction, ids: Sequence[bytes]) -> Prediction:
        """Returns the answer if a robot may try its goals.

        Args:
            answer: The decoded answer.
            ids: The ids that were asked about, 16 bytes each.

        Raises:
            Internal: Goals outside the bounds or not finite; `details["prediction"]` has the answer.
            Invalid: Another shape, means or sigmas that are not finite, other ids.
        """
        shape = (*answer.states.shape[:-1], len(self._lows))
        if not answer.goals.shape == answer.means.shape == answer.sigmas.shape == shape:
            raise Invalid(f"goals, means and sigmas must have the shape {shape}")
        if not (self._has_one(answer) if len(shape) == 1 else self._has_all(answer)):
            raise self._complaint(answer)
        if [one.bytes for one in answer.trial_ids] != ids:
            raise Invalid("it is about other trials than the question")
        return answer

    def _has_one(self, answer: Prediction) -> bool:
        """For one state; numpy is slow for few numbers."""
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
            f"the server proposes a goal outside the bounds: {axis.name!r} must be in [{axis.low}, {axis.high}]"
            f"{axis.unit and ' '}{axis.unit}; got {given}",
            details={"prediction": answer},
        )


@final
class AnswerCheck:
    """Checks a task's answers against the bounds of its specification."""

    def __init__(self) -> None:
        self._known: GoalCheck | None = None

    def check(self, spec: TaskSpec, look: _Look, answer: Prediction, ids: Sequence[bytes]) -> Prediction:
        """As `Goals.check`; before it is refused, the server is asked whether it came back with other data."""
        known = self._known
        if known is None or known.spec is not spec:
            known = self._known = GoalCheck(spec)
        try:
            return known.check(answer, ids)
        except (Internal, Invalid):
            return GoalCheck(look(None)[0]).check(answer, ids)


def check_bounds(known: TaskSpec | None, look: _Look, low: Array, high: Array) -> None:
    """Raises `Invalid` where a model's bounds differ from those of the specification, if that is known."""
    if known is not None and not _are(low, high, known) and not _are(low, high, look(None)[0]):
        raise Invalid("the bounds of its goals are not the task's")


def _are(low: Array, high: Array, spec: TaskSpec) -> bool:
    return all(map(np.array_equal, (low, high), spec.bounds))


def check_receipt(receipt: Receipt, count: int) -> Receipt:
    """Returns the receipt; raises `Invalid` where it is not one of `count` trials."""
    if receipt.accepted + receipt.duplicates != count or len(receipt.seqs) != count:
        raise Invalid(f"it acknowledges {receipt.accepted + receipt.duplicates} trials of {count}")
    return receipt
