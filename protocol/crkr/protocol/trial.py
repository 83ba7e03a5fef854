"""One trial: the goal that was tried in a state, and what it cost."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.protocol.checks import ROUNDING, SINGLE_STEP, choice, cost_number, finite_array, flag, integer, required, text
from crkr.protocol.codec import Array, frozen_from_wire, id_from_wire
from crkr.protocol.errors import Invalid
from crkr.protocol.info import MAX_INFO_BYTES, check_info, info_from_wire
from crkr.protocol.specification.task_spec import TaskSpec

__all__ = ["AMENDABLE", "KINDS", "MAX_INFO_BYTES", "Trial", "flags_of", "may_learn", "success_and_learn"]

# Costs of labelled trials: not 0 and 1, because a label is never certain.
LABEL_COSTS: Final = {True: 0.1, False: 0.9}
AMENDABLE: Final = ("success", "cost", "outcome", "kind", "learn")
KINDS: Final = ("trial", "demonstration", "evaluation", "failed")
_LEARN_TOLD: Final = 2  # of `Trial.flags`
_LEARN: Final = 4


@final
@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A reported sample; make it with `create` or `from_wire`, which check it against the task.

    Attributes:
        id: Chosen by the reporter; the same id is stored once.
        state: (d,) the situation.
        goal: (p,) the meta-parameters that were executed.
        cost: In [0, 1]; None only for kind "failed".
        success: Whether the trial succeeded.
        kind: "trial", "demonstration", "evaluation" or "failed".
        outcome: (q,) measured numbers, NaN where not observed; None where none were given.
        worker: Name of the worker that reported it.
        model_version: The model that proposed the goal.
        info: Plain data for people and exports, as `crkr.protocol.info` has it.
        learn: Whether the regression may learn from it, only for kind "trial"; None: the task's `learn_from` decides.
    """

    id: UUID
    state: Array
    goal: Array
    cost: float | None
    success: bool
    kind: str = "trial"
    outcome: Array | None = None
    worker: str | None = None
    model_version: int | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    learn: bool | None = None

    @classmethod
    def create(
        cls,
        spec: TaskSpec,
        *,
        id: object,  # noqa: A002 - the protocol's word
        state: object,
        goal: object,
        cost: object,
        success: object,
        kind: object = "trial",
        outcome: object = None,
        worker: object = None,
        model_version: object = None,
        info: object = None,
        learn: object = None,
        read_info: Callable[[object], dict[str, Any]] = check_info,
    ) -> Trial:
        """Checks a trial against its task.

        A goal or cost outside its bounds by a rounding error, e.g. of float32, becomes the bound, so that both forms
        are the same trial.

        Raises:
            Invalid: Wrong shapes, values that are not finite, a goal outside the bounds, a cost outside [0, 1], or
                info that would not read back equal.
        """
        plain = read_info(info)
        checked_kind = choice(kind, "kind", KINDS)
        successful = flag(success, "success")
        if checked_kind == "failed" and successful:
            raise Invalid("a trial of kind 'failed' cannot be a success", details={"field": "success"})
        if cost is None and checked_kind != "failed" and spec.cost == "label":
            cost = LABEL_COSTS[successful]
        if cost is None and checked_kind != "failed":
            raise Invalid(
                f"cost may be null only for kind 'failed'; got kind {checked_kind!r}; report one, or make the task "
                'with cost = "label"',
                details={"field": "cost"},
            )
        return cls(
            id=id_from_wire(id),
            state=finite_array(state, "state", (len(spec.state),)),
            goal=_goal(goal, spec),
            cost=None if cost is None else cost_number(cost, "cost"),
            success=successful,
            kind=checked_kind,
            outcome=_outcome(outcome, spec),
            worker=None if worker is None else text(worker, "worker", longest=128),
            model_version=None if model_version is None else integer(model_version, "model_version"),
            info=plain,
            learn=_learn(learn, checked_kind),
        )

    @classmethod
    def from_wire(
        cls, message: object, spec: TaskSpec, read_info: Callable[[object], dict[str, Any]] = info_from_wire
    ) -> Trial:
        """Reads one entry of a report; raises `Invalid`.

        Args:
            message: The entry.
            spec: The task.
            read_info: Reads its `info`; another function for trials stored before the rules.
        """
        if not isinstance(message, Mapping):
            raise Invalid(f"a trial is a map; got {type(message).__name__}")
        outcome = message.get("outcome")
        return cls.create(
            spec,
            id=required(message, "id"),
            state=frozen_from_wire(required(message, "state"), "state"),
            goal=frozen_from_wire(required(message, "goal"), "goal"),
            cost=message.get("cost") if spec.cost == "label" else required(message, "cost"),
            success=required(message, "success"),
            kind=required(message, "kind"),
            outcome=None if outcome is None else frozen_from_wire(outcome, "outcome"),
            worker=message.get("worker"),
            model_version=message.get("model_version"),
            info=message.get("info"),
            learn=message.get("learn"),
            read_info=read_info,
        )

    def to_wire(self) -> dict[str, Any]:
        """The trial as a message map; absent optional fields are left out."""
        message: dict[str, Any] = {
            "id": self.id,
            "state": self.state,
            "goal": self.goal,
            "cost": self.cost,
            "success": self.success,
            "kind": self.kind,
        }
        for name in ("outcome", "worker", "model_version", "learn"):
            value = getattr(self, name)
            if value is not None:
                message[name] = value
        if self.info:
            message["info"] = dict(self.info)
        return message

    def eligible(self, learn_from: str) -> bool:
        """Whether a task that learns from "successes" or from "all" may learn from it."""
        if self.kind != "trial":
            return self.kind == "demonstration"
        return may_learn(self.success, self.learn, learn_from)

    @property
    def flags(self) -> int:
        """`success` and `learn` in one number; 0 or 1 where the task decides `learn`."""
        return flags_of(self.success, self.learn)

    def amended(self, spec: TaskSpec, changes: Mapping[str, Any]) -> Trial:
        """The same trial with another `success`, `cost`, `outcome`, `kind` or `learn`.

        Where the task learns from labels, a new label brings its cost. A trial that becomes "failed" is not a success.

        Raises:
            Invalid: A value that is not allowed, or values that contradict each other.
        """
        values = {name: getattr(self, name) for name in AMENDABLE} | dict(changes)
        if changes.get("kind") == "failed" and "success" not in changes:
            values["success"] = False
        if changes.get("kind", "trial") != "trial" and "learn" not in changes:
            values["learn"] = None  # it is for trials only
        if spec.cost == "label" and "success" in changes and "cost" not in changes:
            values["cost"] = None  # the label's
        rest = {name: getattr(self, name) for name in ("id", "state", "goal", "worker", "model_version")}
        return self.create(spec, **rest, **values, read_info=lambda _: dict(self.info))

    def digest(self) -> bytes:
        """16 bytes, equal for trials with bitwise the same content, provenance aside."""
        cost = struct.pack("<d", float("nan") if self.cost is None else self.cost)
        head = bytes([KINDS.index(self.kind), self.flags, self.outcome is not None, self.cost is not None])
        content = [head, self.state.tobytes(), self.goal.tobytes(), cost]
        if self.outcome is not None:
            content.append(self.outcome.tobytes())
        return blake2b(b"".join(content), digest_size=16).digest()


def flags_of(success: bool, learn: bool | None) -> int:
    """`Trial.flags` for these values."""
    return int(success) | (0 if learn is None else _LEARN_TOLD | _LEARN * learn)


def success_and_learn(flags: int) -> tuple[bool, bool | None]:
    """Success and `learn` of `Trial.flags`."""
    return bool(flags & 1), bool(flags & _LEARN) if flags & _LEARN_TOLD else None


def may_learn(success: bool, learn: bool | None, learn_from: str) -> bool:
    """Whether a task that learns from "successes" or from "all" may learn from a trial of kind "trial"."""
    return (success or learn_from == "all") if learn is None else learn


def _learn(value: object, kind: str) -> bool | None:
    """A trial's `learn`; None for other kinds. Demonstrations are always learned from."""
    if value is None:
        return None
    learn = flag(value, "learn")
    if kind != "trial" and learn != (kind == "demonstration"):
        raise Invalid(
            f"learn cannot be {str(learn).lower()} for kind {kind!r}; only a trial may be learned from or not",
            details={"field": "learn"},
        )
    return learn if kind == "trial" else None


def _goal(value: object, spec: TaskSpec) -> Array:
    goal = finite_array(value, "goal", (len(spec.goal),))
    numbers = goal.tolist()
    for axis, given in zip(spec.goal, numbers, strict=True):
        if not axis.low <= given <= axis.high:
            break
    else:  # the usual case
        return goal
    rounded: dict[int, float] = {}
    for place, (axis, given) in enumerate(zip(spec.goal, numbers, strict=True)):
        if not axis.low <= given <= axis.high:
            bound = axis.low if given < axis.low else axis.high
            if abs(given - bound) > max(ROUNDING * axis.high - ROUNDING * axis.low, SINGLE_STEP * abs(bound)):
                raise Invalid(
                    f"goal {axis.name!r} must be in [{axis.low}, {axis.high}] {axis.unit}; got {given}",
                    details={"field": "goal", "name": axis.name},
                )
            rounded[place] = bound
    goal = goal.copy()
    goal[list(rounded)] = list(rounded.values())
    goal.setflags(write=False)
    return goal


def _outcome(value: object, spec: TaskSpec) -> Array | None:
    if value is None:
        return None
    outcome = finite_array(value, "outcome", (len(spec.outcome),), allow_nan=True)
    canonical = np.where(np.isnan(outcome), np.nan, outcome)  # one bit pattern for "not observed"
    canonical.setflags(write=False)
    return canonical
