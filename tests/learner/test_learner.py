from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from crkr.learner import Learner, radii, top
from crkr.protocol import (
    NoSamples,
    NovelState,
    TaskSpec,
    Unsupported,
)

MakeSpec = Callable[..., TaskSpec]
Teach = Callable[..., Learner]
Look = Callable[[Learner], tuple[Any, ...]]


def test_a_new_learner_is_at_version_one_and_has_nothing_to_say(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    assert learner.version == 1
    assert learner.active_ids == []
    with pytest.raises(NoSamples, match="report a demonstration"):
        learner.predict([0.0, 0.0])
    with pytest.raises(NoSamples):
        learner.explain([0.0, 0.0])
    with pytest.raises(NoSamples):
        learner.refit()


def test_a_demonstration_without_cost_is_reproduced(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(noise_floor=1e-8))
    learner.report(state=[0.5, 0.5], goal=[0.3, -0.2], cost=0.0, success=True, kind="demonstration")
    np.testing.assert_allclose(learner.predict([0.5, 0.5]).goal, [0.3, -0.2], atol=1e-6)
    assert learner.predict([0.5, 0.5]).novelty < 1e-6
    far = learner.predict([1e6, 0.0])
    assert far.novelty == pytest.approx(1.0)
    np.testing.assert_allclose(far.goal, [0.3, -0.2])  # the prior mean


def test_seqs_count_from_two_and_kinds_decide_who_is_learned_from(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    stories = [("demonstration", True), ("trial", True), ("trial", False), ("evaluation", True), ("failed", False)]
    for seq, (kind, success) in enumerate(stories, start=2):
        cost = None if kind == "failed" else 0.5
        receipt = learner.report(state=[seq, 0.0], goal=[0.0, 0.0], cost=cost, success=success, kind=kind)
        assert receipt.seqs == (seq,)
        assert (receipt.accepted, receipt.duplicates, receipt.model_version) == (1, 0, seq)
    assert learner.counts == {"trial": 2, "demonstration": 1, "evaluation": 1, "failed": 1}
    assert learner.model.states[:, 0].tolist() == [2.0, 3.0]
    learner.configure({"learn_from": "all"})
    assert learner.model.states[:, 0].tolist() == [2.0, 3.0, 4.0]
    assert learner.eligible == 3


def test_the_active_set_is_that_of_the_batch_algorithm(make_spec: MakeSpec) -> None:
    spec = make_spec(budget=10, learn_from="all")
    rng = np.random.default_rng(4)
    learner = Learner(spec)
    states, costs = rng.uniform(-2, 2, (80, 2)), rng.uniform(size=80)
    ids = [uuid4() for _ in range(80)]
    learner.report(state=states, goal=np.zeros((80, 2)), cost=costs, success=False, id=ids)
    r2, suppressor = radii(states / spec.lengthscales, costs)
    chosen = top(r2, 10)
    assert learner.active_ids == [ids[index] for index in chosen]
    idle = next(index for index in range(80) if index not in chosen)
    explained = learner.explain([0.0, 0.0], ids[idle]).sample
    assert explained is not None
    assert not explained.active
    assert explained.suppressor == ids[suppressor[idle]]
    assert explained.radius == pytest.approx(np.sqrt(r2[idle]))


def test_a_repeated_report_is_a_duplicate_with_its_first_seq(make_spec: MakeSpec, fingerprint: Look) -> None:
    learner = Learner(make_spec())
    answer = {"state": [0.0, 0.0], "goal": [0.1, 0.1], "cost": 0.2, "success": True, "id": uuid4()}
    learner.report(**answer)  # type: ignore[arg-type]  # fields by name
    before = fingerprint(learner)
    receipt = learner.report(**answer, worker="another", info={"note": "again"})  # type: ignore[arg-type]  # as above
    assert (receipt.accepted, receipt.duplicates, receipt.seqs) == (0, 1, (2,))
    assert fingerprint(learner) == before


def test_a_batch_may_mix_new_trials_and_duplicates(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    first, second = uuid4(), uuid4()
    learner.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.1, success=True, id=first)
    receipt = learner.report(
        state=np.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]),
        goal=np.zeros((3, 2)),
        cost=[0.3, 0.1, 0.3],
        success=True,
        id=[second, first.bytes, second],
    )
    assert (receipt.accepted, receipt.duplicates, receipt.seqs) == (1, 2, (3, 2, 3))


def test_a_selector_that_is_not_offered_here_is_refused_with_what_is(make_spec: MakeSpec) -> None:
    elsewhere = replace(make_spec(), selector="elsewhere")
    with pytest.raises(Unsupported, match="these are: anms, full, freeze"):
        Learner(elsewhere)


def test_near_states_with_opposite_goals_and_no_cost_stay_within_the_range(make_spec: MakeSpec) -> None:
    for cost_map in ("linear", "odds"):
        learner = Learner(make_spec(cost_map=cost_map))
        states = np.array([[0.0, 0.0], [1e-6, 0.0]])
        learner.report(
            state=states, goal=[[-1.0, -1.0], [1.0, 1.0]], cost=np.zeros(2), success=True, kind="demonstration"
        )
        grid = np.stack(np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-2, 2, 41)), axis=-1).reshape(-1, 2)
        means = learner.predict(np.concatenate([grid, states, states * 0.5])).means
        assert np.abs(means).max() <= 1.5


def test_costs_of_zero_at_one_state_do_no_harm(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    learner.report(
        state=np.zeros((50, 2)),
        goal=np.tile([0.5, -0.5], (50, 1)),
        cost=np.zeros(50),
        success=True,
        kind="demonstration",
    )
    np.testing.assert_allclose(learner.predict([0.0, 0.0]).goal, [0.5, -0.5], atol=1e-6)


def test_exploration_stays_within_the_bounds_even_equal_ones(make_spec: MakeSpec) -> None:
    spec = TaskSpec.from_dict(
        {
            **make_spec(1, 1).to_dict(),
            "goal": [
                {"name": "free", "low": -0.1, "high": 0.1},
                {"name": "fixed", "low": 0.3, "high": 0.3, "scale": 1.0},
            ],
            "explore_scale": 10.0,
            "prior_mean": "zero",
        }
    )
    learner = Learner(spec)
    learner.report(state=[0.0], goal=[0.1, 0.3], cost=1.0, success=True)
    goals = learner.predict(np.linspace(-2, 2, 500)[:, None], explore=True).goals
    assert np.abs(goals[:, 0]).max() <= 0.1
    assert np.unique(goals[:, 0]).size == 500
    assert (goals[:, 1] == 0.3).all()


def test_the_prior_mean_follows_the_demonstrations_that_are_left(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    ids = [uuid4(), uuid4()]
    learner.report(
        state=[[0, 0], [1, 1]],
        goal=[[0.2, 0.0], [0.6, 0.4]],
        cost=[0.5, 0.5],
        success=True,
        kind="demonstration",
        id=ids,
    )
    np.testing.assert_allclose(learner.predict([1e5, 0.0]).mean, [0.4, 0.2])
    assert learner.remove(ids[:1]) == 1
    assert learner.remove(ids[:1]) == 0
    np.testing.assert_allclose(learner.predict([1e5, 0.0]).mean, [0.6, 0.4])


def test_a_removed_trial_stays_known(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    fields = {"state": [0.0, 0.0], "goal": [0.1, 0.1], "cost": 0.2, "success": True, "id": uuid4()}
    learner.report(**fields)  # type: ignore[arg-type]  # fields by name
    learner.remove([fields["id"]])  # type: ignore[list-item]  # the id among them
    assert learner.active_ids == []
    receipt = learner.report(**fields)  # type: ignore[arg-type]  # as above
    assert (receipt.duplicates, receipt.seqs, learner.version) == (1, (2,), 3)
    assert learner.eligible == 0


def test_a_better_cost_makes_a_sample_weigh_more(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(prior_mean="zero"))
    trial = uuid4()
    learner.report(state=[0.0, 0.0], goal=[1.0, 1.0], cost=0.9, success=True, id=trial)
    before = learner.predict([0.0, 0.0])
    assert learner.recost([trial], [0.1]) == 1
    after = learner.predict([0.0, 0.0])
    assert (after.mean > before.mean).all()
    assert after.model_version == before.model_version + 1
    assert learner.recost([trial], [0.1]) == 0


def test_novel_states_are_refused_where_the_task_says_so(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(novel="refuse", novelty_limit=0.5))
    learner.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.0, success=True)
    learner.predict([0.1, 0.0])
    for explore in (False, True):
        with pytest.raises(NovelState, match=r"state 1 has novelty 1\.000.*refuses above 0\.5"):
            learner.predict([[0.0, 0.0], [50.0, 0.0]], explore)
    learner.configure({"novel": "predict"})
    assert learner.predict([50.0, 0.0]).novelty == pytest.approx(1.0)


def test_exploration_floor_and_scale_enter_sigma_as_documented(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec(explore_scale=2.0, exploration_floor=0.25))
    learner.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.5, success=True)
    answer = learner.predict([0.4, 0.0])
    np.testing.assert_allclose(answer.sigma, learner.spec.scales * 2.0 * np.sqrt(answer.novelty + 0.25))
    batch = learner.predict([[0.4, 0.0]])
    np.testing.assert_allclose(batch.sigmas[0], answer.sigma, rtol=1e-12)


def test_a_refit_is_taken_only_if_the_evidence_improves_and_leaves_the_selection(
    make_spec: MakeSpec, taught: Teach
) -> None:
    learner = taught(make_spec(budget=40), 150)
    before, version = learner.active_ids, learner.version
    found = learner.refit()
    assert found.after > found.before
    assert found.accepted
    assert learner.version == version + 1
    assert learner.active_ids == before
    np.testing.assert_array_equal(learner.model.parameters.kernel.lengthscales, found.lengthscales)


def test_refits_come_by_themselves_where_the_task_asks_for_them(make_spec: MakeSpec, taught: Teach) -> None:
    learner = taught(make_spec(budget=60, refit_every=40), 120)
    assert not np.array_equal(learner.model.parameters.kernel.lengthscales, learner.spec.lengthscales)


def test_explain_lists_the_samples_that_make_the_mean(make_spec: MakeSpec, taught: Teach) -> None:
    learner = taught(make_spec(budget=8, prior_mean="zero"))
    state = np.array([0.2, -0.3])
    explanation = learner.explain(state)
    weights = {neighbour.id: neighbour.weight for neighbour in explanation.neighbours}
    goals = dict(zip(learner.model.ids, learner.model.goals, strict=True))
    np.testing.assert_allclose(
        sum(weight * goals[trial] for trial, weight in weights.items()), learner.predict(state).mean, rtol=1e-9
    )
    sizes = [abs(neighbour.weight) for neighbour in explanation.neighbours]
    assert sizes == sorted(sizes, reverse=True)
    assert explanation.novelty == pytest.approx(float(learner.predict(state).novelty))
