"""What predict and report promise, held by the learner in process, a task over a live server and its copy alike."""

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from policies import REFUSED, AwaitedPolicy, Fields, LearnedPolicy, MakePolicy, RemotePolicy, specification

from crkr.client import AsyncClient, Client
from crkr.learner import Learner
from crkr.protocol import (
    Conflict,
    Invalid,
    NoSamples,
    NovelState,
)


@pytest.fixture(params=["learner", "task", "mirror", "awaited"])
def make_policy(request: pytest.FixtureRequest, client: Client) -> Iterator[MakePolicy]:
    with ExitStack() as stack:

        def make(**settings: Any) -> LearnedPolicy:
            if request.param == "learner":
                return Learner(specification(**settings))
            task = client.create_task(specification(**settings))
            if request.param == "mirror":
                return RemotePolicy(task, stack.enter_context(task.mirror()))
            if request.param == "task":
                return RemotePolicy(task)
            runner = stack.enter_context(asyncio.Runner())
            awaited = AsyncClient(client.endpoint)
            stack.callback(lambda: runner.run(awaited.close()))
            return AwaitedPolicy(task, awaited.task(task.name), runner)

        yield make


@pytest.fixture
def policy(make_policy: MakePolicy) -> LearnedPolicy:
    return make_policy()


def teach(policy: LearnedPolicy, count: int, seed: int = 0, **fields: Any) -> list[UUID]:
    """`count` successes with costs that differ."""
    rng = np.random.default_rng(seed)
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(count)]
    policy.report(
        state=rng.uniform([0, -1], [2, 1], (count, 2)),
        goal=rng.uniform([-1, 0, 0], [2, 1, 9], (count, 3)),
        cost=rng.uniform(0, 1, count),
        **{"success": True, "id": ids, **fields},
    )
    return ids


def test_nothing_is_predicted_from_nothing(policy: LearnedPolicy) -> None:
    with pytest.raises(NoSamples, match="no active sample"):
        policy.predict([1.0, 0.0])
    with pytest.raises(NoSamples):
        policy.explain([1.0, 0.0])


def test_a_report_is_in_the_next_prediction(policy: LearnedPolicy) -> None:
    receipt = policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=0.0, success=True, kind="demonstration")
    assert (receipt.accepted, receipt.duplicates, receipt.seqs, receipt.model_version) == (1, 0, (2,), 2)
    answer = policy.predict([1.0, 0.0])
    assert (answer.model_version, answer.active, answer.policy) == (2, 1, "mean")
    np.testing.assert_allclose(answer.goal, [0.5, 0.5, 5.0], atol=1e-3)
    assert answer.novelty < 1e-3


def test_one_state_and_a_batch_differ_in_the_leading_dimension_only(policy: LearnedPolicy) -> None:
    teach(policy, 20)
    states = np.random.default_rng(1).uniform(0, 1, (7, 2))
    ids = [uuid4() for _ in states]
    batch = policy.predict(states, True, trial_ids=ids)
    assert (batch.goals.shape, batch.sigmas.shape, batch.novelty.shape) == ((7, 3), (7, 3), (7,))
    assert batch.trial_ids == ids
    for row, state in enumerate(states):
        one = policy.predict(state, True, trial_ids=[ids[row]])
        assert (one.goal.shape, one.sigma.shape, one.novelty.shape) == ((3,), (3,), ())
        assert one.trial_id == ids[row]
        np.testing.assert_allclose(one.goal, batch.goals[row], rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.mean, batch.means[row], rtol=0, atol=1e-9)
        np.testing.assert_allclose(one.novelty, batch.novelty[row], rtol=0, atol=1e-9)


def test_a_batch_is_stored_as_its_trials_one_by_one(make_policy: MakePolicy) -> None:
    together, singly = make_policy(), make_policy()
    rng = np.random.default_rng(2)
    states, goals, costs = rng.uniform(0, 1, (9, 2)), rng.uniform(0, 1, (9, 3)), rng.uniform(0, 1, 9)
    success = rng.uniform(size=9) < 0.7
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(9)]
    receipt = together.report(state=states, goal=goals, cost=costs, success=list(map(bool, success)), id=ids)
    assert receipt.seqs == tuple(range(2, 11))
    for n in range(9):
        one = singly.report(state=states[n], goal=goals[n], cost=costs[n], success=bool(success[n]), id=ids[n])
        assert one.seqs == (n + 2,)
    assert together.active_ids == singly.active_ids
    np.testing.assert_allclose(together.predict(states).means, singly.predict(states).means, rtol=0, atol=1e-9)


def test_a_report_twice_is_stored_once(policy: LearnedPolicy) -> None:
    ids = teach(policy, 5)
    before = policy.predict([1.0, 0.0])
    rng = np.random.default_rng(0)
    again = [UUID(bytes=rng.bytes(16)) for _ in range(5)]
    assert again == ids
    receipt = policy.report(
        state=rng.uniform([0, -1], [2, 1], (5, 2)),
        goal=rng.uniform([-1, 0, 0], [2, 1, 9], (5, 3)),
        cost=rng.uniform(0, 1, 5),
        success=True,
        id=ids,
        worker="another",
        info={"retry": True},
    )
    assert (receipt.accepted, receipt.duplicates, receipt.seqs) == (0, 5, (2, 3, 4, 5, 6))
    after = policy.predict([1.0, 0.0])
    assert after.model_version == before.model_version
    np.testing.assert_array_equal(after.means, before.means)


@pytest.mark.parametrize(
    "change",
    [
        {"cost": 0.25},
        {"state": [1.0, 1e-9]},
        {"goal": [0.5, 0.5, 5.000001]},
        {"success": False},
        {"learn": False},
        {"kind": "evaluation"},
    ],
)
def test_an_id_with_other_content_is_a_conflict_and_stores_nothing(
    policy: LearnedPolicy, change: dict[str, Any]
) -> None:
    first: Fields = {"state": [1.0, 0.0], "goal": [0.5, 0.5, 5.0], "cost": 0.5, "success": True, "id": uuid4()}
    policy.report(**first)
    with pytest.raises(Conflict, match=str(first["id"])):
        policy.report(**{**first, **change})
    fresh = uuid4()
    both: Fields = {"state": [[0.1, 0.1], [1.0, 0.0]], "goal": [[0.5, 0.5, 5.0]] * 2, "cost": [0.1, 0.4]}
    with pytest.raises(Conflict):
        policy.report(**both, success=True, id=[fresh, first["id"]])
    assert policy.active_ids == [first["id"]]
    assert policy.report(state=[0.1, 0.1], goal=[0.5, 0.5, 5.0], cost=0.1, success=True, id=fresh).accepted == 1


def test_an_id_twice_in_one_report_is_the_same_trial_or_a_conflict(policy: LearnedPolicy) -> None:
    twin = uuid4()
    fields: Fields = {"goal": [[0.5, 0.5, 5.0]] * 2, "cost": 0.5, "success": True, "id": [twin, twin]}
    with pytest.raises(Conflict):
        policy.report(state=[[1.0, 0.0], [1.0, 0.1]], **fields)
    receipt = policy.report(state=[[1.0, 0.0], [1.0, 0.0]], **fields)
    assert (receipt.accepted, receipt.duplicates, receipt.seqs) == (1, 1, (2, 2))


def test_goals_stay_within_the_bounds_even_far_away(policy: LearnedPolicy) -> None:
    teach(policy, 30)
    states = np.random.default_rng(3).normal(0, 1e3, (200, 2))
    for explore in (False, True):
        goals = policy.predict(states, explore).goals
        assert (goals >= [-1, 0, 0]).all()
        assert (goals <= [2, 1, 9]).all()


def test_a_trial_id_fixes_the_draw_and_another_changes_it(policy: LearnedPolicy) -> None:
    teach(policy, 30)
    chosen = UUID(int=5)
    first, second = (policy.predict([1.7, -0.9], True, trial_ids=[chosen]) for _ in range(2))
    np.testing.assert_allclose(first.goal, second.goal, rtol=0, atol=1e-9)
    assert first.policy == "explore"
    other = policy.predict([1.7, -0.9], True, trial_ids=[UUID(int=6)])
    assert np.abs(other.goal - first.goal).max() > 1e-6
    assert policy.predict([1.7, -0.9], True).trial_id != policy.predict([1.7, -0.9], True).trial_id


def test_a_failed_or_judged_trial_is_kept_and_not_learned_from(policy: LearnedPolicy) -> None:
    [learned] = teach(policy, 1)
    policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=None, success=False, kind="failed")
    policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=0.1, success=True, kind="evaluation")
    policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=0.1, success=False)
    assert policy.active_ids == [learned]
    assert policy.predict([1.0, 0.0]).model_version == 5


def test_a_trial_may_be_a_success_that_is_not_learned_from_and_a_miss_that_is(policy: LearnedPolicy) -> None:
    [learned] = teach(policy, 1)
    lucky, instructive = uuid4(), uuid4()
    known: Fields = {"state": [1.0, 0.0], "goal": [0.5, 0.5, 5.0], "cost": 0.4}
    policy.report(**known, success=True, learn=False, id=lucky)
    policy.report(**known, success=False, learn=True, id=instructive)
    assert set(policy.active_ids) == {learned, instructive}
    policy.configure({"learn_from": "all"})
    assert set(policy.active_ids) == {learned, instructive}
    again = policy.report(**known, success=True, learn=False, id=lucky)
    assert (again.accepted, again.duplicates) == (0, 1)


@pytest.mark.parametrize(
    ("kind", "learn"), [("failed", True), ("evaluation", True), ("demonstration", False), ("trial", "yes")]
)
def test_what_cannot_be_learned_from_or_always_is_takes_no_other_word(
    policy: LearnedPolicy, kind: str, learn: object
) -> None:
    with pytest.raises(Invalid, match="learn"):
        policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=0.4, success=False, kind=kind, learn=learn)


def test_the_budget_is_kept(make_policy: MakePolicy) -> None:
    policy = make_policy(budget=8)
    ids = teach(policy, 60)
    assert len(policy.active_ids) == 8
    assert set(policy.active_ids) <= set(ids)
    assert policy.predict([1.0, 0.0]).active == 8


def test_costs_are_corrected_and_trials_removed(make_policy: MakePolicy) -> None:
    policy = make_policy(budget=2)
    ids = [uuid4() for _ in range(3)]
    policy.report(
        state=[[0.0, 0.0], [1.0, 0.0], [1.05, 0.0]],
        goal=[[0.5, 0.5, 5.0]] * 3,
        cost=[0.1, 0.2, 0.3],
        success=True,
        id=ids,
    )
    assert policy.active_ids == ids[:2]
    policy.recost([ids[2]], [0.15])
    assert policy.active_ids == [ids[0], ids[2]]
    policy.remove([ids[2]])
    assert policy.active_ids == ids[:2]
    assert policy.explain([0.0, 0.0], ids[2]).sample is not None


def test_an_explanation_says_what_the_goal_rests_on(make_policy: MakePolicy) -> None:
    policy = make_policy(novel="refuse", novelty_limit=0.5)
    ids = teach(policy, 30)
    policy.report(state=[[1.0, 0.0]] * 2, goal=[[0.5, 0.5, 5.0]] * 2, cost=0.9, success=False)
    answer = policy.explain([1.0, 0.0])
    assert answer.grounds is not None
    own = answer.grounds
    assert (own.policy, own.samples, own.tried, own.succeeded) == ("mean", len(ids), 20, 18)
    chance = policy.predict([1.0, 0.0]).success_probability
    assert chance is not None
    assert own.success_probability == pytest.approx(float(chance), abs=1e-9)
    assert answer.summary.startswith("The goal is the mean of 30 samples, the nearest ")
    assert (
        "; 18 of the 20 trials nearest to this state succeeded, and this goal should with probability" in answer.summary
    )
    far = policy.explain([50.0, 0.0])  # a state that the task refuses has no goal
    assert (far.grounds, far.summary, len(far.neighbours)) == (None, "", 10)


def test_a_state_too_novel_is_refused_where_the_task_says_so(make_policy: MakePolicy) -> None:
    policy = make_policy(novel="refuse", novelty_limit=0.5)
    policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=0.1, success=True)
    assert policy.predict([1.0, 0.05]).novelty < 0.5
    for explore in (False, True):
        with pytest.raises(NovelState):
            policy.predict([[1.0, 0.05], [2.0, 1.0]], explore)
    policy.configure({"novel": "predict"})
    assert policy.predict([2.0, 1.0]).novelty > 0.5


@pytest.mark.parametrize(("call", "arguments"), REFUSED)
def test_what_is_not_valid_is_refused_and_changes_nothing(policy: LearnedPolicy, call: str, arguments: Fields) -> None:
    good: Fields = {"state": [1.0, 0.0], "goal": [0.5, 0.5, 5.0], "cost": 0.1, "success": True}
    policy.report(**good)
    with pytest.raises(Invalid):
        getattr(policy, call)(**({**good, **arguments} if call == "report" else arguments))
    assert policy.predict([1.0, 0.0]).model_version == 2


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [({"costs": 0.1}, "unexpected keyword argument 'costs'"), ({}, "needs the keyword arguments: success")],
)
def test_an_argument_that_is_unknown_or_missing_is_a_type_error(
    policy: LearnedPolicy, wrong: Fields, complaint: str
) -> None:
    with pytest.raises(TypeError, match=complaint):
        policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], **wrong)


def test_a_task_may_learn_from_labels_alone(make_policy: MakePolicy) -> None:
    policy = make_policy(cost="label")
    policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], success=True)
    policy.report(state=[1.0, 0.0], goal=[1.5, 0.5, 5.0], success=False)
    policy.report(state=[1.0, 0.5], goal=[0.5, 0.0, 5.0], success=True, cost=0.4)
    answer = policy.predict([1.0, 0.0])
    assert answer.active == 2
    [hit, *_] = policy.explain([1.0, 0.0]).neighbours
    assert hit.cost == pytest.approx(0.1)


def test_a_measured_task_needs_costs(policy: LearnedPolicy) -> None:
    with pytest.raises(Invalid, match="cost"):
        policy.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], success=True)
