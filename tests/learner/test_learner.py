from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.learner import Learner, radii, top
from crkr.protocol import (
    Conflict,
    Invalid,
    NoSamples,
    NovelState,
    TaskSpec,
    Trial,
    Unsupported,
    demonstration_id,
    make_trials,
)

MakeSpec = Callable[..., TaskSpec]


def taught(spec: TaskSpec, count: int = 60, seed: int = 0) -> Learner:
    """A learner with five demonstrations and a stream of trials, half of them successes."""
    rng = np.random.default_rng(seed)
    learner = Learner(spec)
    d, p = len(spec.state), len(spec.goal)
    demonstrations = [demonstration_id(spec.name, index) for index in range(5)]
    learner.report(
        state=rng.uniform(-2, 2, (5, d)),
        goal=rng.uniform(-0.5, 0.5, (5, p)),
        cost=np.zeros(5),
        success=True,
        kind="demonstration",
        id=demonstrations,
    )
    for number in range(count):
        answer = learner.predict(rng.uniform(-2, 2, d), explore=True)
        learner.report(answer, cost=float(rng.uniform()), success=bool(number % 2))
    return learner


def fingerprint(learner: Learner) -> tuple[Any, ...]:
    """Everything a caller can see of a learner."""
    answer = learner.model.predict(np.linspace(-1, 1, 3 * len(learner.spec.state)).reshape(3, -1))
    return (
        learner.version,
        learner.spec,
        learner.active_ids,
        learner.counts,
        learner.eligible,
        answer.means.tobytes(),
        answer.sigmas.tobytes(),
    )


def test_a_new_learner_is_at_version_one_and_has_nothing_to_say(make_spec: MakeSpec) -> None:
    learner = Learner(make_spec())
    assert learner.version == 1
    assert learner.active_ids == []
    for explore in (False, True):
        with pytest.raises(NoSamples, match="report a demonstration"):
            learner.predict([0.0, 0.0], explore=explore)
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


def test_a_repeated_report_is_a_duplicate_with_its_first_seq(make_spec: MakeSpec) -> None:
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


NAMES = tuple(refusals(taught(TaskSpec.from_dict({
    "name": "names",
    "state": [{"name": f"s{i}", "low": -2, "high": 2} for i in range(2)],
    "goal": [{"name": f"g{i}", "low": -1, "high": 1} for i in range(2)],
}), 0)))  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_bad_input_is_refused_and_leaves_the_learner_as_it_was(make_spec: MakeSpec, name: str) -> None:
    learner = taught(make_spec(budget=20))
    before = fingerprint(learner)
    error, words, call = refusals(learner)[name]
    with pytest.raises(error, match=words):
        call()
    assert fingerprint(learner) == before


def test_what_is_not_built_is_refused_with_what_to_do(make_spec: MakeSpec) -> None:
    outcome = [{"name": "miss", "unit": "m", "tolerance": 0.1}]
    with pytest.raises(Unsupported, match=r'exploration.type.*set exploration to \{"type": "gaussian"\}'):
        Learner(make_spec(outcome=outcome))
    Learner(make_spec(outcome=outcome, exploration={"type": "gaussian"}))


def events(learner: Learner, rng: np.random.Generator, trials: list[Trial]) -> list[tuple[str, Any]]:
    """A log of every kind of event, made by using a learner."""
    log: list[tuple[str, Any]] = []
    for start in range(0, len(trials), 10):
        group = trials[start : start + 10]
        seqs = list(range(learner.version + 1, learner.version + 1 + len(group)))
        learner.apply_trials(seqs, group)
        log.append(("trials", (seqs, group)))
        ids = [trial.id for trial in group[:2]]
        step = start // 10
        if step % 3 == 0:
            log.append(("recost", (learner.version + 1, ids, rng.uniform(size=2).tolist())))
            learner.apply_recost(*log[-1][1])
        elif step % 3 == 1:
            log.append(("remove", (learner.version + 1, ids)))
            learner.apply_remove(*log[-1][1])
        if step == 4:
            log.append(("configure", (learner.version + 1, {"budget": 25, "kernel": {"linear_weight": 0.1}})))
            learner.apply_configure(*log[-1][1])
        if step == 7:
            log.append(("configure", (learner.version + 1, {"learn_from": "all", "regularisation": 0.5})))
            learner.apply_configure(*log[-1][1])
        if step == 5:
            found = learner.refit()
            assert found.accepted
            log.append(("fit", (learner.version, found.lengthscales, found.signal_variance)))
    return log


@pytest.mark.parametrize("selector", ["anms", "full", "freeze"])
@pytest.mark.parametrize("way", ["one by one", "grouped", "bulk", "bulk, then one by one"])
def test_replaying_the_events_gives_the_same_learner(make_spec: MakeSpec, selector: str, way: str) -> None:
    rng = np.random.default_rng(11)
    spec = make_spec(3, 2, budget=30, selector=selector)
    trials = list(
        make_trials(
            spec,
            state=rng.uniform(-2, 2, (200, 3)),
            goal=rng.uniform(-1, 1, (200, 2)),
            cost=rng.integers(0, 8, 200) / 8,
            success=list(rng.uniform(size=200) < 0.7),
        )
    )
    first = Learner(spec)
    log = events(first, rng, trials)
    second = Learner(spec)

    def apply(entries: list[tuple[str, Any]]) -> None:
        for kind, arguments in entries:
            if kind == "trials" and way == "one by one":
                for seq, trial in zip(*arguments, strict=True):
                    second.apply_trials([seq], [trial])
            else:
                getattr(second, f"apply_{kind}")(*arguments)

    if way.startswith("bulk"):
        middle = len(log) if way == "bulk" else len(log) // 2
        with second.bulk():
            apply(log[:middle])
        apply(log[middle:])
    else:
        apply(log)
    assert second.version == first.version
    assert second.active_ids == first.active_ids
    assert second.counts == first.counts
    queries, ids = rng.uniform(-3, 3, (50, 3)), [uuid4() for _ in range(50)]
    for explore in (False, True):
        ours, theirs = (learner.predict(queries, explore, ids) for learner in (first, second))
        for name in ("goals", "means", "sigmas", "novelty"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-9, atol=1e-9)


def test_radii_kept_from_an_earlier_life_give_the_same_learner(make_spec: MakeSpec) -> None:
    rng = np.random.default_rng(2)
    spec = make_spec(budget=12)
    trials = make_trials(
        spec, state=rng.uniform(-2, 2, (100, 2)), goal=np.zeros((100, 2)), cost=rng.uniform(size=100), success=True
    )
    first = Learner(spec)
    first.apply_trials(range(2, 102), trials)
    first.apply_remove(102, [trials[3].id, trials[50].id])
    cache = first.radii()
    second = Learner(spec)
    with second.bulk(cache):
        second.apply_trials(range(2, 102), trials)
        second.apply_remove(102, [trials[3].id, trials[50].id])
    more = make_trials(spec, state=[0.3, 0.3], goal=[0.0, 0.0], cost=0.01, success=True)
    for learner in (first, second):
        learner.apply_trials([103], more)
    assert second.active_ids == first.active_ids
    ours, theirs = first.radii(), second.radii()
    assert ours is not None
    assert theirs is not None
    np.testing.assert_array_equal(ours.squared, theirs.squared)
    np.testing.assert_array_equal(ours.seqs, theirs.seqs)


def test_the_same_calls_give_the_same_bits(make_spec: MakeSpec) -> None:
    first, second = (taught(make_spec(3, 4, budget=20, seed=5)) for _ in range(2))
    assert fingerprint(first) == fingerprint(second)
    states = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    ours, theirs = first.predict(states, explore=True), second.predict(states, explore=True)
    assert ours.trial_ids == theirs.trial_ids
    assert ours.goals.tobytes() == theirs.goals.tobytes()


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


def test_a_refit_is_taken_only_if_the_evidence_improves_and_leaves_the_selection(make_spec: MakeSpec) -> None:
    learner = taught(make_spec(budget=40), 150)
    before, version = learner.active_ids, learner.version
    found = learner.refit()
    assert found.after > found.before
    assert found.accepted
    assert learner.version == version + 1
    assert learner.active_ids == before
    np.testing.assert_array_equal(learner.model.parameters.kernel.lengthscales, found.lengthscales)


def test_refits_come_by_themselves_where_the_task_asks_for_them(make_spec: MakeSpec) -> None:
    learner = taught(make_spec(budget=60, refit_every=40), 120)
    assert not np.array_equal(learner.model.parameters.kernel.lengthscales, learner.spec.lengthscales)


def test_explain_lists_the_samples_that_make_the_mean(make_spec: MakeSpec) -> None:
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
