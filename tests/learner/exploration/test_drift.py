"""A robot that changes, in a world that is a line."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import Array, TaskSpec, Trial, training_id

MakeSpec = Callable[..., TaskSpec]

J = np.array([[0.5, 0.2, 0.0], [-0.1, 0.4, 0.2]])
TOLERANCE = 0.05


def outcome_of(state: Array, goal: Array, shift: float) -> Array:
    return np.asarray(0.3 * state + J @ (goal + shift) - 0.1)


@pytest.fixture
def spec(make_spec: MakeSpec) -> TaskSpec:
    outcome = [{"name": name, "tolerance": TOLERANCE, "group": "miss"} for name in "ab"]
    return make_spec(2, 3, outcome=outcome, exploration={"type": "outcome"}, seed=1)


def train(learner: Learner, first: int, count: int, shift: float = 0.0, at: float | None = None) -> list[bool]:
    """Whether each of these trials succeeded; with `at` all are in one state."""
    rng, won = np.random.default_rng(first), []
    for number in range(first, first + count):
        state = rng.uniform(-0.5, 0.5, 2) if at is None else np.full(2, at)
        answer = learner.predict(state, True, training_id("t", 0, 1, number))
        outcome = outcome_of(state, answer.goal, shift) + 0.005 * rng.normal(size=2)
        won.append(bool((np.abs(outcome) < TOLERANCE).all()))
        learner.report(answer, cost=0.1, success=won[-1], outcome=outcome)
    return won


def rate(learner: Learner, shift: float) -> float:
    states = np.random.default_rng(99).uniform(-0.5, 0.5, (200, 2))
    goals = learner.predict(states).goals
    hits = [np.abs(outcome_of(*pair, shift)).max() < TOLERANCE for pair in zip(states, goals, strict=True)]
    return float(np.mean(hits))


def test_it_starts_from_nothing_and_steady_trials_raise_no_alarm(spec: TaskSpec) -> None:
    learner = Learner(spec)
    train(learner, 0, 400)
    assert rate(learner, 0.0) > 0.95
    assert learner.drift is not None
    assert learner.drift.restarts == 0


@pytest.mark.parametrize("seed", [1, 3])
def test_a_young_model_of_a_folding_arm_is_not_taken_for_a_changed_robot(make_spec: MakeSpec, seed: int) -> None:
    outcome = [{"name": name, "tolerance": TOLERANCE, "group": "miss"} for name in "ab"]
    start = {"type": "space-filling", "count": 60}
    learner = Learner(make_spec(2, 25, outcome=outcome, exploration={"type": "outcome"}, start=start, seed=seed))
    rng = np.random.default_rng(seed)
    for number in range(100):
        state = rng.uniform(-0.7, 0.7, 2)
        answer = learner.predict(state, True, training_id("t", 0, 1, number))
        angles = np.cumsum(answer.goal.reshape(5, 5) @ [0.1, 0.2, 0.4, 0.8, 1.2])
        outcome_here = np.array([np.cos(angles).mean(), np.sin(angles).mean()]) - state
        success = bool((np.abs(outcome_here) < TOLERANCE).all())
        learner.report(answer, cost=0.1, success=success, outcome=outcome_here)
    assert learner.drift is not None
    assert learner.drift.restarts == 0


def test_a_changed_robot_is_noticed_and_learned_anew(spec: TaskSpec) -> None:
    learner = Learner(spec)
    train(learner, 0, 200)
    assert rate(learner, 0.6) < 0.3
    train(learner, 200, 20, shift=0.6)
    assert learner.drift is not None
    assert learner.drift.restarts == 1
    assert rate(learner, 0.6) > 0.95
    assert learner.active_ids  # what succeeded before is kept


def test_a_robot_that_is_set_right_again_is_known_as_before(spec: TaskSpec) -> None:
    learner = Learner(spec)
    train(learner, 0, 200)
    train(learner, 200, 60, shift=0.6, at=0.4)
    train(learner, 260, 10, at=0.4)
    assert learner.drift is not None
    assert learner.drift.restarts == 2
    assert rate(learner, 0.0) > 0.95  # in all states, of which the trials since the first change say nothing


def test_a_changed_robot_is_the_same_learned_at_once_or_step_by_step(make_spec: MakeSpec, spec: TaskSpec) -> None:
    learner = Learner(spec)
    train(learner, 0, 200)
    train(learner, 200, 30, shift=0.6)
    assert learner.drift is not None
    restart = learner.drift.last_seq
    assert restart is not None
    known = learner.history
    trials = [
        Trial(
            training_id("t", 0, 1, row), state, goal, 0.1, bool((np.abs(outcome) < TOLERANCE).all()), "trial", outcome
        )
        for row, (state, goal, outcome) in enumerate(zip(known.states, known.goals, known.outcomes, strict=True))
    ]
    again = Learner(spec)
    with again.bulk():
        again.apply_trials(range(2, restart), trials[: restart - 2])
        again.apply_restart(restart)
        again.apply_trials(range(restart + 1, 233), trials[restart - 2 :])
    for told in (learner, again):
        told.remove([training_id("t", 0, 1, 7), training_id("t", 0, 1, 205)])
    states = np.random.default_rng(3).uniform(-0.5, 0.5, (20, 2))
    for name in ("goals", "predicted_outcome", "predicted_outcome_sd"):
        expected, found = (getattr(told.predict(states), name) for told in (learner, again))
        np.testing.assert_array_equal(found, expected)


def test_no_model_restarts_where_that_is_turned_off(make_spec: MakeSpec, spec: TaskSpec) -> None:
    off = TaskSpec.from_dict({**spec.to_dict(), "exploration": {"type": "outcome", "drift": False}})
    learner = Learner(off)
    train(learner, 0, 150)
    train(learner, 150, 60, shift=0.6)
    assert learner.drift is not None
    assert (learner.drift.restarts, learner.drift.due) == (0, False)


def test_success_probabilities_are_near_what_happens(spec: TaskSpec) -> None:
    learner = Learner(spec)
    train(learner, 0, 300)
    told = learner.predict(np.random.default_rng(5).uniform(-0.5, 0.5, (200, 2))).success_probability
    assert told is not None
    assert abs(float(told.mean()) - rate(learner, 0.0)) < 0.1


def test_what_a_removal_leaves_for_later_is_worked_out_in_any_steps(spec: TaskSpec) -> None:
    at_once, in_steps = Learner(spec), Learner(spec)
    for learner in (at_once, in_steps):
        train(learner, 0, 250)
        assert learner.model.explorer.prepare()
        learner.remove([training_id("t", 0, 1, 249)])
        assert not learner.model.explorer.prepare()
    explorer, steps = in_steps.model.explorer, 1
    while not explorer.prepare(7):
        steps += 1
    assert steps > 20
    for first in (250, 260):
        expected, found = (learner.predict(np.zeros((3, 2))) for learner in (at_once, in_steps))
        assert expected.success_probability is not None
        assert np.isfinite(expected.success_probability).all()
        for name in ("goals", "success_probability", "predicted_outcome_sd"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
        for learner in (at_once, in_steps):
            train(learner, first, 10)
    assert at_once.drift == in_steps.drift
