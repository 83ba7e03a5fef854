"""Histories that teach nothing, or the wrong thing: answers stay goals, and advice says why."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import Array, Prediction, TaskSpec

MakeSpec = Callable[..., TaskSpec]
Told = Callable[[np.random.Generator, int], dict[str, Any]]

REFUSED: dict[str, Any] = {"kind": "failed", "cost": None, "success": False}
HISTORIES: dict[str, tuple[Told, set[str]]] = {
    "only refusals": (lambda _, q: {**REFUSED, "outcome": np.full(q, np.nan)}, {"no_success", "many_refusals"}),
    "measured refusals": (lambda rng, q: {**REFUSED, "outcome": rng.normal(size=q)}, {"no_success", "many_refusals"}),
    "only failures": (lambda _, q: {"cost": 1.0, "success": False, "outcome": np.full(q, 9.0)},
                      {"no_success", "outcome_constant"}),
    "never measured": (lambda _, q: {"cost": 1.0, "success": False, "outcome": np.full(q, np.nan)},
                       {"no_success", "no_outcome"}),
    "only successes": (lambda rng, q: {"cost": 0.0, "success": True, "outcome": 0.01 * rng.normal(size=q)}, set()),
    "contradictions": (lambda rng, q: {"cost": 0.5, "success": bool(rng.integers(2)),
                                       "outcome": rng.choice([-5.0, 5.0], q)}, set()),
    "absurd": (lambda rng, q: {"cost": 0.5, "success": bool(rng.integers(2)),
                               "outcome": rng.choice([-1e300, 1e300], q)}, set()),
}  # fmt: skip


def specification(make_spec: MakeSpec, d: int, p: int, q: int, **fields: Any) -> TaskSpec:
    return make_spec(d, p, outcome=[{"name": f"o{n}", "tolerance": 0.1} for n in range(q)], **fields)


def sound(answer: Prediction, spec: TaskSpec) -> bool:
    """Whether goals are within the bounds, and all else is a number or not known."""
    low, high = spec.bounds
    chance, deviation = answer.success_probability, answer.predicted_outcome_sd
    within = bool(((answer.goals >= low) & (answer.goals <= high)).all())
    likely = chance is None or bool(np.all(np.isnan(chance) | ((chance >= 0) & (chance <= 1))))
    return within and likely and (deviation is None or bool(np.all(np.isnan(deviation) | (deviation >= 0))))


def tried(learner: Learner, told: Told, count: int, states: Callable[[np.random.Generator], Array]) -> Iterator[bool]:
    rng = np.random.default_rng(5)
    for number in range(count):
        answer = learner.predict(states(rng), explore=True, trial_ids=UUID(int=number + 1))
        learner.report(answer, **told(rng, len(learner.spec.outcome)))
        yield sound(answer, learner.spec)


@pytest.mark.parametrize("history", HISTORIES)
def test_what_teaches_nothing_gives_goals_and_advice(make_spec: MakeSpec, history: str) -> None:
    told, codes = HISTORIES[history]
    learner = Learner(specification(make_spec, 2, 2, 2))
    assert all(tried(learner, told, 200, lambda rng: rng.uniform(-2, 2, 2)))
    probes = np.random.default_rng(6).uniform(-2, 2, (20, 2))
    if learner.model.active or learner.model.explorer.guides:
        assert sound(learner.predict(probes), learner.spec)
    assert codes <= {one.code for one in learner.advice}


@pytest.mark.parametrize(("d", "p", "q", "budget"), [(1, 1, 1, 1), (1, 3, 2, 1), (6, 1, 1, 5), (100, 100, 3, 10)])
def test_one_dimension_or_a_hundred_and_a_budget_of_one(
    make_spec: MakeSpec, d: int, p: int, q: int, budget: int
) -> None:
    learner = Learner(specification(make_spec, d, p, q, budget=budget))
    told: Told = lambda rng, q: {  # noqa: E731 - a history like those above
        "cost": 0.3,
        "success": bool(rng.integers(2)),
        "outcome": rng.normal(size=q),
    }
    assert all(tried(learner, told, 40, lambda rng: rng.uniform(-2, 2, d)))
    assert learner.model.active <= budget
    assert sound(learner.predict(np.zeros((3, d))), learner.spec)


def test_the_same_trial_over_and_over(make_spec: MakeSpec) -> None:
    learner = Learner(specification(make_spec, 2, 2, 1))
    for number in range(60):
        learner.report(state=[1.0, 0.0], goal=[0.5, 1.0], cost=0.2, success=number % 2 > 0, outcome=[0.05])
        if number:
            for explore in (False, True):
                assert sound(learner.predict([1.0, 0.0], explore, UUID(int=number)), learner.spec)
    assert {"goals_on_bounds", "outcome_constant"} <= {one.code for one in learner.advice}
