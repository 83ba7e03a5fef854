"""What is to be believed of an answer, whoever gave it: goals that the task can have, receipts for what was sent."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Any, TypeAlias, final
from uuid import UUID

import numpy as np

from crkr.protocol import (
    Array,
    CrkrError,
    Internal,
    Invalid,
    Prediction,
    Receipt,
    TaskSpec,
    array_from_wire,
)
from crkr.protocol.codec import MAX_DEPTH

__all__ = ["Belief", "Goals", "check_bounds", "check_receipt", "plain", "reading"]

_Look: TypeAlias = Callable[[float | None], tuple[TaskSpec, bool]]  # asks the server for a task's specification


@final
class reading:  # noqa: N801 - it reads as a phrase, `with reading(verb):`
    """Turns a complaint about an answer into `Internal`: it is the server that is wrong, not the caller."""

    __slots__ = ("_verb",)

    def __init__(self, verb: str) -> None:
        self._verb = verb

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if isinstance(error, Invalid | TypeError | ValueError | KeyError | AttributeError):
            raise Internal(f"the server's answer to {self._verb} cannot be read: {error}") from error


def plain(value: Any, depth: int = MAX_DEPTH) -> Any:
    """A decoded message with its array maps as arrays and its ids as UUIDs, all the way down.

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
