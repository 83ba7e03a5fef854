"""The arguments of `report`, in process or remote, and the trials made from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict
from uuid import UUID, uuid4

import numpy as np

from crkr.protocol.checks import finite_array, refuse_masked
from crkr.protocol.codec import id_from_wire
from crkr.protocol.earlier_python import Unpack
from crkr.protocol.errors import Invalid
from crkr.protocol.messages.predict import Prediction, check_states
from crkr.protocol.specification.task_spec import TaskSpec
from crkr.protocol.trial import Trial

__all__ = ["TrialFields", "make_trials"]


class _Told(TypedDict):
    success: object


class TrialFields(_Told, total=False):
    """The arguments of every `report`, in process or remote, for one trial or for a batch of b.

    Attributes:
        state: (d,) or (b, d); state and goal may be omitted with an answer of `predict`.
        goal: (p,) or (b, p) executed, within the bounds; overrides the answer's goals.
        cost: In [0, 1], one or b; None or omitted for kind "failed", and where the task's cost is a "label".
        success: Whether it succeeded: one flag, or b.
        kind: "trial", "demonstration", "evaluation" or "failed", for all of them; "trial" unless given.
        id: One id, or b; the answer's, or new ones, unless given.
        outcome: (q,) or (b, q) measured, NaN where not observed.
        worker: Name of the reporting process.
        model_version: The model that proposed the goals; the answer's unless given.
        info: Plain data to keep: one map for all, or b of them.
        learn: Whether the regression may learn from it: one flag, or b; the task's `learn_from` decides unless given.
    """

    state: object
    goal: object
    cost: object
    kind: str
    id: UUID | bytes | Sequence[UUID | bytes] | None
    outcome: object
    worker: str | None
    model_version: int | None
    info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None
    learn: object


def make_trials(spec: TaskSpec, answer: Prediction | None = None, **fields: Unpack[TrialFields]) -> tuple[Trial, ...]:
    """Checks the arguments of `report` and makes the trials.

    Args:
        spec: The task.
        answer: The prediction that was tried; gives state, goal, ids and model_version.
        fields: What was tried and its result, see `TrialFields`.

    Raises:
        Invalid: Neither answer nor state and goal, sizes that disagree, or a value that is not allowed.
        TypeError: An argument is unknown, or success is missing.
    """
    _check_names(fields)
    state, goal, ids = fields.get("state"), fields.get("goal"), fields.get("id")
    outcome, model_version = fields.get("outcome"), fields.get("model_version")
    if answer is not None:
        state = answer.states if state is None else state
        goal = answer.goals if goal is None else goal
        ids = answer.trial_ids if ids is None else ids
        model_version = answer.model_version if model_version is None else model_version
    if state is None or goal is None:
        raise Invalid("report needs an answer of predict, or both state and goal")
    states = check_states(state, len(spec.state))
    count = 1 if states.ndim == 1 else len(states)
    leading = () if states.ndim == 1 else (count,)
    goals = finite_array(goal, "goal", (*leading, len(spec.goal)))
    outcomes = None
    if outcome is not None:
        outcomes = finite_array(outcome, "outcome", (*leading, len(spec.outcome)), allow_nan=True).reshape(count, -1)
    each_id = [uuid4() for _ in range(count)] if ids is None else _one_each(ids, "id", count)
    costs, successes = _one_each(fields.get("cost"), "cost", count), _one_each(fields["success"], "success", count)
    infos, learn = _one_each(fields.get("info"), "info", count), _one_each(fields.get("learn"), "learn", count)
    return tuple(
        Trial.create(
            spec,
            id=id_from_wire(each_id[i]),
            state=states.reshape(count, -1)[i],
            goal=goals.reshape(count, -1)[i],
            cost=costs[i],
            success=successes[i],
            kind=fields.get("kind", "trial"),
            outcome=None if outcomes is None else outcomes[i],
            worker=fields.get("worker"),
            model_version=model_version,
            info=infos[i],
            learn=learn[i],
        )
        for i in range(count)
    )


def _check_names(fields: TrialFields) -> None:
    """Raises `TypeError`, as a signature with these names would."""
    if unknown := fields.keys() - TrialFields.__annotations__.keys():
        raise TypeError(f"report() got an unexpected keyword argument {min(unknown)!r}")
    if missing := TrialFields.__required_keys__ - fields.keys():
        raise TypeError(f"report() needs the keyword arguments: {', '.join(sorted(missing))}")


def _one_each(value: Any, name: str, count: int) -> list[Any]:
    """`count` values, from one value for all or one for each."""
    if value is None or isinstance(value, bool | int | float):  # most are
        return [value] * count
    refuse_masked(value, name)
    listed = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)
    values = list(value) if listed else [value] * count
    if len(values) != count:
        raise Invalid(f"{name} must have one entry a state: {count}; got {len(values)}", details={"field": name})
    return values
