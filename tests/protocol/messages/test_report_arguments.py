"""The arguments of `report`, for one and for a batch, as checked trials."""

from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from crkr.protocol import Invalid, Prediction, TaskSpec, make_trials

SPEC = TaskSpec.from_dict(
    {
        "name": "throw",
        "state": [{"name": "x", "low": 0, "high": 1}, {"name": "y", "low": 0, "high": 1}],
        "goal": [{"name": "g", "low": -1, "high": 2}],
        "outcome": [{"name": "o", "tolerance": 0.1}, {"name": "u", "tolerance": 0.1}],
    }
)


def answer(count: int | None) -> Prediction:
    lead = () if count is None else (count,)
    ids = [uuid4() for _ in range(count or 1)]
    zeros = np.zeros((*lead, 1))
    return Prediction(
        np.full((*lead, 2), 0.5), np.full((*lead, 1), 1.5), zeros, zeros, np.zeros(lead), ids, 42, 5, "mean"
    )


def test_an_answer_gives_state_goal_ids_and_version() -> None:
    given = answer(3)
    made = make_trials(
        SPEC, given, cost=[0.1, 0.2, 0.3], success=[True, False, True], info=[{"n": n} for n in range(3)]
    )
    assert [trial.id for trial in made] == given.trial_ids
    assert [(trial.cost, trial.success, trial.info["n"], trial.model_version) for trial in made] == [
        (0.1, True, 0, 42), (0.2, False, 1, 42), (0.3, True, 2, 42),
    ]  # fmt: skip
    assert all(trial.goal == [1.5] for trial in made)


def test_one_value_serves_a_whole_batch_and_arguments_overrule_the_answer() -> None:
    given = answer(2)
    made = make_trials(SPEC, given, goal=[[0.0], [0.5]], cost=0.5, success=False, kind="evaluation", model_version=7)
    assert [(trial.goal[0], trial.cost, trial.kind, trial.model_version) for trial in made] == [
        (0.0, 0.5, "evaluation", 7), (0.5, 0.5, "evaluation", 7),
    ]  # fmt: skip
    single = make_trials(SPEC, answer(None), cost=0.0, success=True, outcome=[0.1, np.nan])
    assert len(single) == 1
    without = make_trials(SPEC, state=[0, 0], goal=[0], cost=0, success=True)[0].id
    assert without != make_trials(SPEC, state=[0, 0], goal=[0], cost=0, success=True)[0].id


@pytest.mark.parametrize(
    "change",
    [
        {"state": None},
        {"goal": None},
        {"goal": 3.0},
        {"goal": [[0.0]]},
        {"cost": [0.1]},
        {"cost": [[0.1, 0.2], [0.3]]},
        {"success": [True] * 3},
        {"success": "yes"},
        {"id": [uuid4()]},
        {"id": 5},
        {"id": "ab"},
        {"outcome": [0.1, 0.2]},
        {"info": [{}]},
        {"info": 3},
        {"kind": ["trial", "trial"]},
        {"state": [[0, 0], [0]]},
        {"state": 5},
    ],
)
def test_arguments_that_do_not_fit_each_other_are_refused(change: dict[str, Any]) -> None:
    fitting: dict[str, Any] = {"state": [[0, 0], [1, 1]], "goal": [[0.0], [1.0]], "cost": 0.5, "success": True}
    assert len(make_trials(SPEC, **fitting)) == 2
    with pytest.raises(Invalid):
        make_trials(SPEC, **{**fitting, **change})
