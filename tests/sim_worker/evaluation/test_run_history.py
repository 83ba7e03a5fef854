"""A run as its log tells it."""

from uuid import uuid4

import pytest

from crkr.protocol import StoredTrial, TaskSpec, Trial
from crkr.sim_worker.evaluation.run_history import RunHistory

AXES = [{"name": "x", "unit": "m", "low": -1.0, "high": 1.0}]
SPEC = TaskSpec.from_dict({"name": "small", "state": AXES, "goal": AXES, "budget": 3})


def stored(seq: int, kind: str, success: bool, **info: object) -> StoredTrial:
    cost = None if kind == "failed" else 0.5
    trial = Trial.create(SPEC, id=uuid4(), state=[0.0], goal=[0.0], cost=cost, success=success, kind=kind, info=info)
    return StoredTrial(trial, seq, time=100.0 + 0.1 * seq)


def test_training_trials_are_the_kinds_trial_and_failed() -> None:
    history = RunHistory(SPEC)
    for seq, kind in enumerate(["demonstration", "trial", "failed", "evaluation", "trial"], 2):
        history.add(stored(seq, kind, False))
    assert history.trained == 3
    assert history.samples == 5
    assert history.last_seq == 6


def test_the_active_set_is_full_when_as_many_samples_are_learned_from_as_the_budget_allows() -> None:
    history = RunHistory(SPEC)
    rows = [("demonstration", True), ("trial", False), ("trial", True), ("failed", False), ("trial", True)]
    for seq, (kind, success) in enumerate(rows, 2):
        assert history.filled_at is None
        history.add(stored(seq, kind, success))
    assert history.filled_at == 4


def test_an_epoch_is_scored_by_every_criterion_of_the_skill() -> None:
    history = RunHistory(SPEC)
    for ball, (paper, strict) in enumerate([(True, True), (True, False), (False, False), (True, False)]):
        outcomes = {"paper": paper, "strict": strict}
        history.add(stored(ball + 2, "evaluation", strict, epoch=3, ball=ball, trained=151, outcomes=outcomes))
    history.add(stored(9, "evaluation", True, ball=0))  # recorded by hand: of no epoch
    assert [score.to_dict() for score in history.epochs] == [
        {"epoch": 3, "trials": 151, "paper": 0.75, "strict": 0.25, "contexts": 4, "balls": 4}
    ]


def test_a_criterion_is_rated_over_the_trials_that_it_was_said_of() -> None:
    history = RunHistory(SPEC)
    for ball in range(50):
        outcomes = {"paper": ball % 2 == 0, "strict": False}
        history.add(stored(ball + 2, "evaluation", False, epoch=0, ball=ball, trained=0, outcomes=outcomes))
    history.add(stored(52, "evaluation", True, epoch=0, ball=50, trained=0))  # names no criterion of its own
    (score,) = history.epochs
    assert score.tally.rates() == {"paper": 0.5, "strict": 0.0, "success": 1.0}


def test_the_rate_counts_this_session_only() -> None:
    history = RunHistory(SPEC)
    for seq in [2, 3, 4, 100, 101, 102]:
        history.add(stored(seq, "trial", True))
    assert history.rate(since=3) == pytest.approx(10.0)
    assert history.rate(since=6) == 0.0
