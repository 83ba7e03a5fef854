"""Goals that measured outcomes guide, in worlds whose answer is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from scipy.special import ndtri

from crkr.learner import Learner, Model, OutcomeExplorer, truncated_normal, uniforms
from crkr.learner.exploration.outcome_model import OutcomeModel
from crkr.learner.exploration.outcome_posterior import condition_within
from crkr.protocol import Array, Prediction, TaskSpec, Trial, make_trials, pack, unpack

MakeSpec = Callable[..., TaskSpec]

D, P = 2, 3
TARGET = np.array([0.5, -0.2])
TOLERANCE = 0.05
A = np.array([[0.3, -0.2], [0.1, 0.4]])
J = np.array([[0.5, 0.2, 0.0], [-0.1, 0.4, 0.2]])


def outcome_of(states: Array, goals: Array) -> Array:
    """o = A s + J g + b; the mean goal of 0 is off wherever A s is not small."""
    return np.asarray(states @ A.T + goals @ J.T + TARGET)


@pytest.fixture
def guided(make_spec: MakeSpec) -> Callable[..., TaskSpec]:
    def make(groups: str = "aa", tolerance: float = TOLERANCE, **exploration: Any) -> TaskSpec:
        entries = [
            {"name": f"o{index}", "tolerance": tolerance, "target": TARGET[index], "group": group}
            for index, group in enumerate(groups)
        ]
        exploration = {"type": "outcome", "min_trials": 10, **exploration}
        return make_spec(D, P, outcome=entries, exploration=exploration, seed=5)

    return make


def tried(spec: TaskSpec, count: int, seed: int = 0, hide: float = 0.0) -> list[Trial]:
    """Trials around the goal 0, of which few succeed and all are measured; a share `hide` only the first entry."""
    rng = np.random.default_rng(seed)
    states, goals = rng.uniform(-2, 2, (count, D)), rng.uniform(-0.4, 0.4, (count, P))
    outcomes = outcome_of(states, goals)
    outcomes[rng.uniform(size=count) < hide, 1] = np.nan
    return list(
        make_trials(
            spec,
            state=states,
            goal=goals,
            cost=rng.uniform(0.1, 0.5, count),
            success=list(rng.uniform(size=count) < 0.2),
            outcome=outcomes,
            id=[UUID(bytes=rng.bytes(16)) for _ in range(count)],
        )
    )


def taught(spec: TaskSpec, count: int = 400, seed: int = 0, hide: float = 0.0) -> Learner:
    learner = Learner(spec)
    learner.report(state=np.zeros(D), goal=np.zeros(P), cost=0.0, success=True, kind="demonstration")
    learner.apply_trials(range(3, 3 + count), tried(spec, count, seed, hide))
    return learner


def off(answer: Prediction) -> Array:
    """The largest true miss of each goal, in tolerances."""
    return np.asarray(np.abs((outcome_of(answer.states, answer.goals) - TARGET) / TOLERANCE).max(axis=-1))


STATES = np.random.default_rng(9).uniform(-0.6, 0.6, (40, D))
IDS = [UUID(int=number) for number in range(40)]


def test_misses_teach_where_to_aim(guided: Callable[..., TaskSpec]) -> None:
    learner = taught(guided(gate=0.0))
    answer = learner.predict(STATES)
    plain = np.abs((outcome_of(STATES, answer.means) - TARGET) / TOLERANCE).max(axis=1)
    assert plain.max() > 4
    assert off(answer).max() < 1.0
    assert answer.policy == "corrected"


def test_the_corrected_goal_is_the_analytic_solution_in_a_world_that_is_a_line(
    guided: Callable[..., TaskSpec],
) -> None:
    spec = guided(gate=0.0, candidates=0)
    answer = taught(spec, 1000).predict(STATES / 4)
    own = spec.scales
    assert np.abs((outcome_of(answer.states, answer.means) - TARGET) / TOLERANCE).sum(axis=1).max() < 3
    for row, state in enumerate(answer.states):
        S = np.diag((4.0 * answer.sigmas[row]) ** 2)
        mean = answer.means[row]
        miss = TARGET - outcome_of(state, mean)
        expected = mean + S @ J.T @ np.linalg.solve(J @ S @ J.T + TOLERANCE**2 * np.eye(2), miss)
        np.testing.assert_allclose(answer.goals[row] / own, expected / own, atol=0.05)


def test_what_would_stick_out_of_the_bounds_is_made_up_for_by_the_rest(guided: Callable[..., TaskSpec]) -> None:
    states = np.array([[-2.0, 0.2], [-2.0, 0.25]])
    answer = taught(guided(gate=0.0), 1000).predict(states)
    assert (answer.goals[:, 0] == 1.0).all()
    for state in states:
        rest = np.linalg.lstsq(J[:, 1:], TARGET - outcome_of(state, np.array([1.0, 0.0, 0.0])), rcond=None)[0]
        assert np.abs(rest).max() < 1
    assert off(answer).max() < 1.0


def test_predicted_outcomes_are_in_the_outcomes_units_and_true(guided: Callable[..., TaskSpec]) -> None:
    learner = taught(guided())
    for explore in (False, True):
        answer = learner.predict(STATES, explore, IDS)
        assert answer.predicted_outcome is not None
        assert answer.predicted_outcome_sd is not None
        true = outcome_of(STATES, answer.goals)
        np.testing.assert_allclose(answer.predicted_outcome, true, atol=0.5 * TOLERANCE)
        assert (answer.predicted_outcome_sd > 0).all()
        assert (answer.predicted_outcome_sd < TOLERANCE).all()


def test_the_gate_leaves_alone_what_should_do(guided: Callable[..., TaskSpec]) -> None:
    answer = taught(guided(gate=2.0)).predict(STATES)
    assert answer.corrected is not None
    expected = np.abs((outcome_of(STATES, answer.means) - TARGET) / TOLERANCE).max(axis=1)
    clear = np.abs(expected - 2.0) > 0.5
    np.testing.assert_array_equal(answer.corrected[clear], expected[clear] > 2.0)
    assert 5 < answer.corrected.sum() < 35
    np.testing.assert_array_equal(answer.goals[~answer.corrected], np.clip(answer.means, -1, 1)[~answer.corrected])
    for row in (int(answer.corrected.argmax()), int(answer.corrected.argmin())):
        alone = taught(guided(gate=2.0)).predict(STATES[row])
        assert alone.policy == ("corrected" if answer.corrected[row] else "mean")


def test_exploring_leaves_free_what_does_not_change_the_outcome(guided: Callable[..., TaskSpec]) -> None:
    learner = taught(guided(tolerance=0.01, temperature=[0.3]), 600)
    state, ids = np.array([0.3, -0.2]), [UUID(int=number) for number in range(2000)]
    answer = learner.predict(np.tile(state, (2000, 1)), True, ids)
    assert answer.policy == "explore"
    null = np.cross(J[0], J[1])
    along = answer.goals @ null / np.linalg.norm(null)
    across = answer.goals @ np.linalg.svd(J)[2][:2].T
    assert along.std() > 5 * across.std(axis=0).max()
    assert off(answer).max() < 3.0


@pytest.mark.parametrize("kind", ["line", "quadratic", "gp"])
def test_only_a_line_is_straight(kind: str, guided: Callable[..., TaskSpec]) -> None:
    explorer = taught(guided(model=kind), 200).model.explorer
    assert isinstance(explorer, OutcomeExplorer)
    z, goal = np.zeros((1, D)), np.zeros((1, P))
    model = OutcomeModel.near(explorer.trials, explorer.scales, (0,), z, goal, explorer.settings)
    goals = np.arange(-12.0, 13.0, 4.0)[:, None] * np.array([0.5, -0.2, 0.3])
    along = model.prospect(goals[None]).raw[0]
    bends = np.abs(np.diff(along, 2, axis=0)).max() / np.abs(along).max()
    assert bool(bends < 1e-6) is (kind == "line")


def test_a_draw_is_the_first_within_the_bounds_of_documented_numbers(guided: Callable[..., TaskSpec]) -> None:
    spec = guided(temperature=[0.2, 0.6, 6.0], iterations=1)
    model = taught(spec, 600).model
    explorer, beyond, seen = model.explorer, 0, set()
    assert isinstance(explorer, OutcomeExplorer)
    own, attempts = explorer.scales, 16
    for number in range(60):
        trial, state = UUID(int=number), STATES[number % 40] / 4  # none of whose means misses by far
        answer = model.predict(state, True, trial)
        z, mean = own.metric.standardise(state)[None], own.scaled(answer.means)[None]
        spread = np.minimum(4 * answer.sigmas / own.scales, own.high - own.low)[None]
        near = OutcomeModel.near(explorer.trials, own, (0,), z, mean, explorer.settings)
        posterior = condition_within(mean, spread, near.line(mean), own)
        if np.linalg.norm(0.5 * (posterior.g - mean)) > 0.25 * np.sqrt(near.farthest[0]):
            near = OutcomeModel.near(explorer.trials, own, (0,), z, posterior.g, explorer.settings)
            posterior = condition_within(mean, spread, near.line(posterior.g), own)
        u = uniforms(5, [trial], P + 1 + attempts * (1 + P + 3))[0]
        temperature = (0.2, 0.6, 6.0)[int(3 * u[P])]
        normal = ndtri(u[P + 1 + attempts :].reshape(1, attempts, P + 3))
        drawn = posterior.g[0] + temperature * posterior.deviations(normal)[0]
        inside = np.asarray(((drawn >= own.low) & (drawn <= own.high)).all(axis=1))
        expected = drawn[inside.argmax()] if inside.any() else np.clip(drawn[0], own.low, own.high)
        np.testing.assert_allclose(answer.goal, expected * own.scales, atol=1e-9)
        beyond += int(not bool(inside[0]))
        seen.add(temperature)
    assert beyond
    assert len(seen) == 3


def test_a_draw_that_never_lies_within_is_moved_to_the_bounds(guided: Callable[..., TaskSpec]) -> None:
    model = taught(guided(temperature=[1e6])).model
    goals = model.predict(STATES, True, IDS).goals
    assert (np.abs(goals) == 1.0).all()
    assert model.predict(STATES, True, IDS).goals.tobytes() == goals.tobytes()


def test_before_enough_outcomes_everything_is_as_in_the_paper(make_spec: MakeSpec, guided: Any) -> None:
    plain_spec = make_spec(D, P, outcome=guided().to_dict()["outcome"], exploration={"type": "gaussian"}, seed=5)
    learner, plain = taught(guided(min_trials=51), 50), taught(plain_spec, 50)
    for explore in (False, True):
        ours, theirs = learner.predict(STATES, explore, IDS), plain.predict(STATES, explore, IDS)
        assert ours.goals.tobytes() == theirs.goals.tobytes()
        assert ours.policy == theirs.policy
        assert ours.predicted_outcome is None
    [more] = tried(guided(), 1, seed=77)
    learner.apply_trials([99], [more])
    assert learner.predict(STATES).predicted_outcome is not None


def test_a_task_without_outcomes_draws_as_documented(make_spec: MakeSpec) -> None:
    spec = make_spec(D, P, seed=5)
    learner = Learner(spec)
    learner.report(state=STATES, goal=STATES[:, [0, 1, 0]] / 2, cost=np.full(40, 0.3), success=True)
    answer = learner.predict(STATES[:7] * 1.3, True, IDS[:7])
    expected = truncated_normal(answer.means, answer.sigmas, *spec.bounds, uniforms(5, IDS[:7], P))
    assert answer.goals.tobytes() == expected.tobytes()
    assert answer.corrected is None
    assert answer.predicted_outcome_sd is None


def test_every_array_of_an_answer_is_read_only(guided: Callable[..., TaskSpec]) -> None:
    model = taught(guided()).model
    for states, explore in ((STATES, False), (STATES[0], False), (STATES, True), (STATES[0], True)):
        answer = model.predict(states, explore, IDS[: 1 if states.ndim == 1 else 40])
        arrays = [getattr(answer, field.name) for field in fields(answer)]
        found = [array for array in arrays if isinstance(array, np.ndarray)]
        assert len(found) == 9
        assert not any(array.flags.writeable for array in found)


def test_a_batch_is_its_states_one_by_one(guided: Callable[..., TaskSpec]) -> None:
    model = taught(guided("ab"), hide=0.5).model
    for explore in (False, True):
        batch = model.predict(STATES, explore, IDS)
        assert batch.corrected is not None
        for row in range(40):
            one = model.predict(STATES[row], explore, IDS[row])
            for name in ("goals", "predicted_outcome", "predicted_outcome_sd"):
                np.testing.assert_allclose(getattr(one, name), getattr(batch, name)[row], rtol=1e-9, atol=1e-9)
            assert one.corrected is not None
            assert one.corrected == batch.corrected[row]
            assert one.goal.shape == (P,)
            assert one.policy == ("explore" if explore else "corrected" if one.corrected else "mean")


def test_a_question_repeated_gets_the_same_bits_and_another_id_another_goal(guided: Callable[..., TaskSpec]) -> None:
    model = taught(guided()).model
    first, again, other = (model.predict(STATES[0], True, one) for one in (IDS[0], IDS[0], IDS[1]))
    assert first.goal.tobytes() == again.goal.tobytes()
    assert first.goal.tobytes() != other.goal.tobytes()


def test_a_group_seen_too_seldom_is_not_modelled(guided: Callable[..., TaskSpec]) -> None:
    answer = taught(guided("ab", gate=0.0), 300, hide=0.99).predict(STATES)
    assert answer.predicted_outcome is not None
    assert np.isfinite(answer.predicted_outcome[:, 0]).all()
    assert np.isnan(answer.predicted_outcome[:, 1]).all()
    miss = (outcome_of(STATES, answer.goals) - TARGET) / TOLERANCE
    assert np.abs(miss[:, 0]).max() < 1.0
    both = taught(guided("ab", gate=0.0), 300, hide=0.6).predict(STATES)
    assert off(both).max() < 1.5


def test_a_group_seen_in_part_counts_as_not_seen(guided: Callable[..., TaskSpec]) -> None:
    learner = taught(guided("aa"), 300, hide=1.0)
    assert learner.predict(STATES).predicted_outcome is None


def test_judged_and_removed_trials_do_not_guide(guided: Callable[..., TaskSpec]) -> None:
    spec = guided()
    learner, without = taught(spec), taught(spec)
    version = learner.version
    judged = [
        Trial(uuid4(), one.state, one.goal, one.cost, one.success, "evaluation", np.array([9.0, 9.0]))
        for one in tried(spec, 30, seed=3)
    ]
    wrong = [
        Trial(uuid4(), one.state, one.goal, one.cost, False, "trial", np.array([9.0, -9.0]))
        for one in tried(spec, 30, seed=4)
    ]
    learner.apply_trials(range(version + 1, version + 31), judged)
    for explore in (False, True):
        ours, theirs = learner.predict(STATES, explore, IDS), without.predict(STATES, explore, IDS)
        assert ours.goals.tobytes() == theirs.goals.tobytes()
    learner.apply_trials(range(version + 31, version + 61), wrong)
    assert not np.allclose(learner.predict(STATES).goals, without.predict(STATES).goals, atol=1e-3)
    learner.remove([one.id for one in wrong])
    for explore in (False, True):
        ours, theirs = learner.predict(STATES, explore, IDS), without.predict(STATES, explore, IDS)
        np.testing.assert_allclose(ours.goals, theirs.goals, rtol=1e-9, atol=1e-9)


def test_a_trial_that_failed_but_was_measured_guides(guided: Callable[..., TaskSpec]) -> None:
    learner = Learner(guided())
    learner.report(state=np.zeros(D), goal=np.zeros(P), cost=0.0, success=True, kind="demonstration")
    for one in tried(guided(), 100):
        learner.report(
            state=one.state, goal=one.goal, cost=None, success=False, kind="failed", outcome=one.outcome, id=one.id
        )
    assert learner.predict(STATES).policy == "corrected"


def test_a_model_answers_the_same_after_the_learner_has_moved_on(guided: Callable[..., TaskSpec]) -> None:
    spec = guided()
    learner = taught(spec)
    model, before = learner.model, learner.model.predict(STATES, True, IDS).goals.tobytes()
    learner.remove([one.id for one in tried(spec, 400)[:200]])
    learner.report(state=STATES, goal=np.zeros((40, P)), cost=np.ones(40), success=False, outcome=np.full((40, 2), 3.0))
    assert model.predict(STATES, True, IDS).goals.tobytes() == before
    assert learner.predict(STATES, True, IDS).goals.tobytes() != before


def test_misses_teach_the_same_in_any_order(guided: Callable[..., TaskSpec]) -> None:
    spec = guided("ab")
    misses = [replace(one, success=False) for one in tried(spec, 300, hide=0.4)]
    answers = []
    for order in (np.arange(300), np.random.default_rng(8).permutation(300)):
        learner = Learner(spec)
        learner.report(state=np.zeros(D), goal=np.zeros(P), cost=0.0, success=True, kind="demonstration")
        learner.apply_trials(range(3, 303), [misses[index] for index in order])
        answers.append([learner.predict(STATES, explore, IDS).goals for explore in (False, True)])
    for ours, theirs in zip(*answers, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)


def test_a_mirror_without_the_trials_answers_plainly_and_says_so(guided: Callable[..., TaskSpec]) -> None:
    model = taught(guided(gate=0.0)).model
    mirror = Model.from_wire(unpack(pack(model.to_wire())))
    ours, theirs = model.predict(STATES), mirror.predict(STATES)
    assert (ours.policy, theirs.policy) == ("corrected", "mean")
    assert theirs.means.tobytes() == ours.means.tobytes()
    np.testing.assert_array_equal(theirs.goals, np.clip(ours.means, -1, 1))
    assert theirs.predicted_outcome is None
    drawn = mirror.predict(STATES, True, IDS)
    np.testing.assert_array_equal(
        drawn.goals, truncated_normal(drawn.means, drawn.sigmas, *guided().bounds, uniforms(5, IDS, P))
    )


def test_without_a_success_a_bad_outcome_goes_before_one_that_was_not_observed(guided: Callable[..., TaskSpec]) -> None:
    learner = Learner(guided("ab", min_trials=2))
    for number, (goal, outcome) in enumerate([(0.1, [0.5, 0.2]), (0.2, [0.5, np.nan]), (0.3, [0.5, np.nan])]):
        state, tried_goal, trial_id = np.zeros(D), np.full(P, goal), UUID(int=number + 1)
        learner.report(state=state, goal=tried_goal, id=trial_id, cost=0.9, success=False, outcome=outcome)
    np.testing.assert_allclose(learner.predict(np.zeros(D)).means, 0.1)
    aimed = learner.predict(np.full(D, 0.3))
    np.testing.assert_allclose(aimed.means, 0.1)
