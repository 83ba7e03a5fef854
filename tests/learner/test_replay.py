from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.learner import Learner, TrialColumns
from crkr.protocol import (
    KINDS,
    Conflict,
    Invalid,
    TaskSpec,
    Trial,
    make_trials,
)

MakeSpec = Callable[..., TaskSpec]
Teach = Callable[..., Learner]
Look = Callable[[Learner], tuple[Any, ...]]


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
        else:
            log.append(("amend", (learner.version + 1, *amended(group[:4] + trials[:2], rng))))
            learner.apply_amend(*log[-1][1])
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


def amended(trials: list[Trial], rng: np.random.Generator) -> tuple[list[UUID], list[dict[str, Any]]]:
    """Trials, some of them removed before, that are now judged otherwise."""
    values = [
        {
            "cost": float(rng.uniform()),
            "success": bool(rng.uniform() < 0.5),
            "learn": None if rng.uniform() < 0.7 else bool(rng.uniform() < 0.5),
            "kind": str(rng.choice(["trial", "trial", "demonstration", "evaluation", "failed"])),
            "outcome": None if rng.uniform() < 0.2 else rng.normal(size=2).tolist(),
            "removed": bool(rng.uniform() < 0.2),
        }
        for _ in trials
    ]
    return [trial.id for trial in trials], values


def as_columns(seqs: Sequence[int], trials: Sequence[Trial]) -> TrialColumns:
    return TrialColumns(
        seqs=np.array(seqs),
        ids=b"".join(trial.id.bytes for trial in trials),
        digests=b"".join(trial.digest() for trial in trials),
        states=np.array([trial.state for trial in trials]),
        goals=np.array([trial.goal for trial in trials]),
        costs=np.array([np.nan if trial.cost is None else trial.cost for trial in trials]),
        kinds=np.array([KINDS.index(trial.kind) for trial in trials], dtype=np.uint8),
        flags=np.array([trial.flags for trial in trials], dtype=np.uint8),
        outcomes=np.array([np.full(2, np.nan) if trial.outcome is None else trial.outcome for trial in trials]),
    )


def test_columns_are_refused_out_of_order_out_of_bulk_and_with_a_known_id(make_spec: MakeSpec) -> None:
    spec = make_spec()
    trials = make_trials(spec, state=np.zeros((3, 2)), goal=np.zeros((3, 2)), cost=np.zeros(3), success=True)
    learner = Learner(spec)
    with pytest.raises(Invalid, match="bulk"):
        learner.apply_columns(as_columns([2, 3, 4], trials))
    with pytest.raises(Invalid, match="one entry a trial"):
        replace(as_columns([2, 3, 4], trials), flags=np.array([1], dtype=np.uint8))
    with learner.bulk():
        with pytest.raises(Invalid, match="ascend"):
            learner.apply_columns(as_columns([2, 4, 3], trials))
        learner.apply_columns(as_columns([2, 3], trials[:2]))
        with pytest.raises(Conflict, match="log position 5 repeats"):
            learner.apply_columns(as_columns([4, 5], [trials[2], trials[0]]))


def test_columns_without_outcomes_are_refused_where_they_are_learned_from(make_spec: MakeSpec) -> None:
    spec = make_spec(outcome=[{"name": "miss", "tolerance": 0.2}])
    trials = make_trials(spec, state=np.zeros((3, 2)), goal=np.zeros((3, 2)), cost=np.zeros(3), success=True)
    learner = Learner(spec)
    with learner.bulk(), pytest.raises(Invalid, match="columns must have them"):
        learner.apply_columns(replace(as_columns([2, 3, 4], trials), outcomes=None))


@pytest.mark.parametrize("selector", ["anms", "full", "freeze"])
@pytest.mark.parametrize("way", ["one by one", "grouped", "bulk", "bulk, then one by one", "bulk, as columns"])
def test_replaying_the_events_gives_the_same_learner(make_spec: MakeSpec, selector: str, way: str) -> None:
    rng = np.random.default_rng(11)
    outcome = [{"name": name, "tolerance": 0.2, "group": name} for name in ("near", "far")]
    spec = make_spec(3, 2, budget=30, selector=selector, outcome=outcome)
    measured = rng.normal(size=(200, 2))
    measured[rng.uniform(size=200) < 0.4, 1] = np.nan
    trials = list(
        make_trials(
            spec,
            state=rng.uniform(-2, 2, (200, 3)),
            goal=rng.uniform(-1, 1, (200, 2)),
            cost=rng.integers(0, 8, 200) / 8,
            success=list(rng.uniform(size=200) < 0.7),
            outcome=measured,
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
            elif kind == "trials" and way == "bulk, as columns":
                second.apply_columns(as_columns(*arguments))
            else:
                getattr(second, f"apply_{kind}")(*arguments)

    if way.startswith("bulk"):
        middle = len(log) // 2 if way == "bulk, then one by one" else len(log)
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
        assert ours.predicted_outcome is not None
        for name in ("goals", "means", "sigmas", "novelty", "predicted_outcome", "predicted_outcome_sd"):
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


def test_an_amended_history_is_learned_as_if_it_had_been_reported_so(make_spec: MakeSpec) -> None:
    rng = np.random.default_rng(3)
    spec = make_spec(budget=12, outcome=[{"name": name, "tolerance": 0.2} for name in ("near", "far")])
    states, goals, costs = rng.uniform(-2, 2, (80, 2)), rng.uniform(-1, 1, (80, 2)), rng.uniform(size=80)
    success, outcome = rng.uniform(size=80) < 0.5, rng.normal(size=(80, 2))
    ids = [uuid4() for _ in range(80)]

    def learned(success: Any, costs: Any, outcome: Any) -> Learner:
        learner = Learner(spec)
        trials = make_trials(
            spec, state=states, goal=goals, cost=costs, success=success.tolist(), outcome=outcome, id=ids
        )
        for seq, trial in enumerate(trials, 2):
            learner.apply_trials([seq], [trial])
        return learner

    first, wrong = learned(success, costs, outcome), rng.choice(80, 30, replace=False)
    success[wrong], costs[wrong], outcome[wrong] = ~success[wrong], costs[wrong] / 2, outcome[wrong] + 1
    for seq, one in enumerate(wrong, first.version + 1):
        values = {"cost": costs[one], "success": bool(success[one]), "outcome": outcome[one].tolist()}
        first.apply_amend(seq, [ids[one]], [{**values, "kind": "trial", "learn": None, "removed": False}])
        radii = first.radii()
        assert radii is not None
        assert len(radii.seqs) == len(radii.squared) == first.eligible
    second = learned(success, costs, outcome)
    assert first.active_ids == second.active_ids
    assert first.eligible == second.eligible
    queries, draws = rng.uniform(-2, 2, (20, 2)), [uuid4() for _ in range(20)]
    ours, theirs = (learner.predict(queries, True, draws) for learner in (first, second))
    for name in ("goals", "means", "sigmas", "predicted_outcome"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-9, atol=1e-9)


def test_the_same_calls_give_the_same_bits(make_spec: MakeSpec, taught: Teach, fingerprint: Look) -> None:
    first, second = (taught(make_spec(3, 4, budget=20, seed=5)) for _ in range(2))
    assert fingerprint(first) == fingerprint(second)
    states = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    ours, theirs = first.predict(states, explore=True), second.predict(states, explore=True)
    assert ours.trial_ids == theirs.trial_ids
    assert ours.goals.tobytes() == theirs.goals.tobytes()


def test_trials_replayed_in_bulk_count_towards_the_next_fit() -> None:
    spec = TaskSpec.from_dict(
        {
            "name": "t",
            "state": [{"name": "x", "low": 0, "high": 1}],
            "goal": [{"name": "g", "low": 0, "high": 1}],
            "refit_every": 40,
        }
    )
    states = np.linspace(0, 1, 45)[:, None]
    trials = make_trials(spec, state=states, goal=states, cost=0.5, success=True)
    live, restarted = Learner(spec), Learner(spec)
    live.apply_trials(range(2, 47), trials)
    with restarted.bulk(None):
        restarted.apply_trials(range(2, 47), trials)
    assert live.refit_due
    assert restarted.refit_due
