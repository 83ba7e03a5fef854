from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import (
    Conflict,
    Invalid,
    TaskSpec,
    make_trials,
)

MakeSpec = Callable[..., TaskSpec]
Look = Callable[[Learner], tuple[Any, ...]]


def learner_of(spec: TaskSpec) -> Learner:
    rng = np.random.default_rng(0)
    learner = Learner(spec)
    learner.report(
        state=rng.uniform(-2, 2, (40, 2)),
        goal=rng.uniform(-1, 1, (40, 2)),
        cost=rng.uniform(size=40),
        success=True,
        kind="demonstration",
    )
    return learner


def refusals(learner: Learner) -> dict[str, tuple[type[Exception], str, Callable[[], object]]]:
    """Every bad call, with the error and the words it must give."""
    good = {"state": [0.0, 0.0], "goal": [0.0, 0.0], "cost": 0.5, "success": True}
    known = learner.active_ids[0]

    def report(**changes: Any) -> Callable[[], object]:
        return lambda: learner.report(**{**good, **changes})

    trial = make_trials(learner.spec, state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.5, success=True)
    return {
        "state of another shape": (Invalid, r"states? must have shape \(2,\); got \(3,\)", report(state=[0.0] * 3)),
        "state not a number": (Invalid, "states? must be finite; got nan", report(state=[0.0, np.nan])),
        "state infinite": (Invalid, "states? must be finite; got inf", report(state=[np.inf, 0.0])),
        "state text": (Invalid, "states? must be an array of numbers", report(state=["a", "b"])),
        "goal of another shape": (Invalid, r"goal must have shape \(2,\); got \(1,\)", report(goal=[0.0])),
        "goal outside its bounds": (Invalid, r"goal 'g1' must be in \[-1.0, 1.0\].*got 1.5", report(goal=[0.0, 1.5])),
        "cost above one": (Invalid, r"cost must be a finite number in \[0.0, 1.0\]; got 1.1", report(cost=1.1)),
        "cost below zero": (Invalid, "cost must be.*got -0.1", report(cost=-0.1)),
        "cost not a number": (Invalid, "cost must be.*got nan", report(cost=np.nan)),
        "cost absent": (Invalid, "cost may be null only for kind 'failed'", report(cost=None)),
        "unknown kind": (Invalid, "kind must be one of.*got 'test'", report(kind="test")),
        "id of another length": (Invalid, "id must be 16 bytes", report(id=b"short")),
        "id with other content": (Conflict, "other content", report(id=known)),
        "one bad trial of several": (
            Invalid,
            r"states? must be finite; got nan at \[1, 0\]",
            report(state=[[0.0, 0.0], [np.nan, 0.0]], goal=np.zeros((2, 2)), cost=[0.1, 0.2]),
        ),
        "an id twice with other content": (
            Conflict,
            "twice in one report",
            report(state=np.zeros((2, 2)), goal=np.zeros((2, 2)), cost=[0.1, 0.2], id=[known.bytes[::-1]] * 2),
        ),
        "as many costs as states": (
            Invalid,
            "cost must have one entry a state: 2; got 3",
            report(state=np.zeros((2, 2)), goal=np.zeros((2, 2)), cost=[0.1] * 3),
        ),
        "predict with another shape": (Invalid, "states must have shape", lambda: learner.predict(np.zeros(5))),
        "predict with nan": (Invalid, "states must be finite", lambda: learner.predict([np.nan, 0.0])),
        "predict with too many ids": (
            Invalid,
            "trial_ids must be 1",
            lambda: learner.predict([0, 0], True, [known] * 2),
        ),
        "recost of an unknown id": (Invalid, "unknown ids", lambda: learner.recost([UUID(int=5)], [0.1])),
        "recost outside the range": (Invalid, r"cost must be.*\[0.0, 1.0\]", lambda: learner.recost([known], [2.0])),
        "recost with too few costs": (Invalid, r"costs must have shape \(1,\)", lambda: learner.recost([known], [])),
        "recost of an id twice": (Invalid, "ids must differ", lambda: learner.recost([known, known], [0.1, 0.2])),
        "remove of an unknown id": (Invalid, "unknown ids", lambda: learner.remove([known, UUID(int=5)])),
        "budget below one": (
            Invalid,
            r"budget must be a whole number in \[1,",
            lambda: learner.configure({"budget": 0}),
        ),
        "lambda zero": (Invalid, "regularisation must be", lambda: learner.configure({"regularisation": 0.0})),
        "lambda negative": (Invalid, "regularisation must be", lambda: learner.configure({"regularisation": -1})),
        "a fixed field": (Invalid, "seed cannot be changed", lambda: learner.configure({"budget": 9, "seed": 3})),
        "a fit without spread": (Invalid, "lengthscales must be positive", lambda: learner.apply_fit(99, [0, 1], 1.0)),
        "a fit of another shape": (Invalid, "lengthscales must have shape", lambda: learner.apply_fit(99, [1.0], 1.0)),
        "explain with another shape": (Invalid, "state must have shape", lambda: learner.explain([0.0])),
        "explain an unknown sample": (Invalid, "unknown ids", lambda: learner.explain([0.0, 0.0], UUID(int=5))),
        "a seq from the past": (Invalid, "seqs must be 1 ascending", lambda: learner.apply_trials([1], trial)),
        "seqs of another number": (Invalid, "seqs must be 1 ascending", lambda: learner.apply_trials([98, 99], trial)),
        "a remove from the past": (Invalid, "seqs must be", lambda: learner.apply_remove(1, [known])),
    }


PLANE = {
    "name": "plane",
    "state": [{"name": name, "low": -2, "high": 2} for name in "xy"],
    "goal": [{"name": name, "low": -1, "high": 1} for name in ("g0", "g1")],
}
NAMES = tuple(refusals(learner_of(TaskSpec.from_dict(PLANE))))


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_refused_and_leaves_the_learner_as_it_was(
    make_spec: MakeSpec, name: str, fingerprint: Look
) -> None:
    learner = learner_of(make_spec(budget=20))
    before = fingerprint(learner)
    error, words, call = refusals(learner)[name]
    with pytest.raises(error, match=words):
        call()
    assert fingerprint(learner) == before
