"""What limits learning is told by rules over the newest trials, and nothing is told where nothing limits it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import TaskSpec

MakeSpec = Callable[..., TaskSpec]
MISS = {"outcome": [{"name": "miss", "tolerance": 0.1}]}


def codes(learner: Learner) -> list[str]:
    return [one.code for one in learner.advice]


def told(spec: TaskSpec, count: int = 200, **fields: Any) -> Learner:
    """A learner of trials like any other, where `fields` say no different."""
    rng, learner = np.random.default_rng(0), Learner(spec)
    given: dict[str, Any] = {
        "state": rng.uniform(-2, 2, (count, 2)),
        "goal": rng.uniform(-0.9, 0.9, (count, 2)),
        "cost": rng.uniform(0.1, 0.9, count),
        "success": [bool(won) for won in rng.uniform(size=count) < 0.9],
    }
    if spec.outcome:
        given["outcome"] = rng.normal(size=(count, len(spec.outcome)))
    learner.report(**{**given, **fields})
    return learner


def test_nothing_is_advised_where_nothing_is_known_or_nothing_is_wrong(make_spec: MakeSpec) -> None:
    assert codes(Learner(make_spec())) == []
    assert codes(told(make_spec())) == []
    assert codes(told(make_spec(**MISS))) == []
    assert codes(told(make_spec(**MISS), 20, success=False, goal=np.ones((20, 2)))) == []


FAILED = {"kind": "failed", "cost": None, "success": False}
CASES: list[tuple[str, dict[str, Any], dict[str, Any], str]] = [
    ("no_success", MISS, {"success": False}, "no success in 200 trials"),
    ("cost_saturated", {"learn_from": "all"}, {"cost": np.ones(200)}, "100% of the newest 200 executed trials"),
    ("cost_saturated", {}, {"cost": np.zeros(200)}, 'cost = "label"'),
    ("goals_on_bounds", {}, {"goal": np.tile([0.3, 1.0], (200, 1))}, "at a bound of g1;"),
    ("no_outcome", {}, {"success": False}, "declare an outcome: 0% of the newest 200"),
    ("no_outcome", MISS, {"outcome": np.full((200, 1), np.nan)}, "outcome miss was not observed"),
    ("outcome_constant", MISS, {"outcome": np.full((200, 1), 0.3)}, "outcome miss is the same in every trial"),
    ("state_outside", {}, {"state": np.tile([0.0, 5.0], (200, 1))}, "low and high of s1"),
    ("many_refusals", MISS, FAILED, "100% of the newest 200 goals were not executed"),
]


@pytest.mark.parametrize(("code", "settings", "fields", "says"), CASES)
def test_what_is_wrong_is_told(
    make_spec: MakeSpec, code: str, settings: dict[str, Any], fields: dict[str, Any], says: str
) -> None:
    learner = told(make_spec(**settings), **fields)
    [message] = [one.message for one in learner.advice if one.code == code]
    assert says in message


def test_a_clearance_that_is_always_kept_need_not_change(make_spec: MakeSpec) -> None:
    entry = {"name": "clearance", "tolerance": 0.1, "target": 0.05, "aim": "at_least"}
    assert codes(told(make_spec(outcome=[entry]), outcome=np.full((200, 1), 0.2))) == []
    assert codes(told(make_spec(outcome=[entry]), outcome=np.full((200, 1), 0.0))) == ["outcome_constant"]


def test_advice_is_of_the_newest_trials_and_ends_with_its_reason(make_spec: MakeSpec) -> None:
    learner = told(make_spec(**MISS), success=False)
    assert codes(learner) == ["no_success"]
    rng = np.random.default_rng(1)
    learner.report(state=[0.0, 0.0], goal=[0.5, 0.5], cost=0.5, success=True, outcome=rng.normal(size=1))
    assert codes(learner) == []


def test_the_trend_compares_the_newest_trials_with_those_before(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    assert learner.history.trend() == (0, None, None, 0, None)
    for won in (False, True):
        learner.report(state=np.zeros((200, 2)), goal=np.zeros((200, 2)), cost=np.full(200, 0.5), success=won)
    learner.report(state=np.zeros((9, 2)), goal=np.zeros((9, 2)), cost=0.5, success=True, kind="evaluation")
    assert learner.history.trend() == (200, 1.0, 0.0, 9, 1.0)
