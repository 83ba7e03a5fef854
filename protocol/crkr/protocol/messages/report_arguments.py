"""From the arguments of `report`, in process or remote, to checked trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from uuid import UUID, uuid4

import numpy as np

from crkr.protocol.checks import finite_array, refuse_masked
from crkr.protocol.codec import id_from_wire
from crkr.protocol.errors import Invalid
from crkr.protocol.messages.predict import Prediction, check_states
from crkr.protocol.specification.task_spec import TaskSpec
from crkr.protocol.trial import Trial

__all__ = ["make_trials"]


def make_trials(
    spec: TaskSpec,
    answer: Prediction | None = None,
    *,
    state: Any = None,
    goal: Any = None,
    cost: Any,
    success: Any,
    kind: str = "trial",
    id: UUID | bytes | Sequence[UUID | bytes] | None = None,  # noqa: A002 - the protocol's word
    outcome: Any = None,
    worker: str | None = None,
    model_version: int | None = None,
    info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
) -> tuple[Trial, ...]:
    """The trials that the arguments of `report` mean, for one or for a batch.

    Args:
        spec: The task.
        answer: The prediction that was tried: gives state, goal, ids and model_version.
        state: (d,) or (b, d) where there is no answer.
        goal: (p,) or (b, p) that was executed; overrides the answer's goals.
        cost: One cost in [0, 1] or None, or b of them.
        success: One flag, or b of them.
        kind: The kind of all of them.
        id: One id, or b of them; the answer's, or random ones, where absent.
        outcome: (q,) or (b, q), or None.
        worker: Who reports.
        model_version: The model that proposed the goals.
        info: One map for all, or b of them.

    Raises:
        Invalid: Neither answer nor state and goal, sizes that disagree, or a value that is not allowed.
    """
    if answer is not None:
        state = answer.states if state is None else state
        goal = answer.goals if goal is None else goal
        id = answer.trial_ids if id is None else id  # noqa: A001 - as above
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
    ids = [uuid4() for _ in range(count)] if id is None else _one_each(id, "id", count)
    costs, successes = _one_each(cost, "cost", count), _one_each(success, "success", count)
    infos = _one_each(info, "info", count)
    return tuple(
        Trial.create(
            spec,
            id=id_from_wire(ids[i]),
            state=states.reshape(count, -1)[i],
            goal=goals.reshape(count, -1)[i],
            cost=costs[i],
            success=successes[i],
            kind=kind,
            outcome=None if outcomes is None else outcomes[i],
            worker=worker,
            model_version=model_version,
            info=infos[i],
        )
        for i in range(count)
    )


def _one_each(value: Any, name: str, count: int) -> list[Any]:
    """`count` values, from one for all or one each."""
    refuse_masked(value, name)
    listed = isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.ndim > 0)
    values = list(value) if listed else [value] * count
    if len(values) != count:
        raise Invalid(f"{name} must have one entry a state: {count}; got {len(values)}", details={"field": name})
    return values
