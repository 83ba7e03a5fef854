"""What two workers and an evaluator leave in the log when all goes well."""

import math
from collections import Counter
from typing import Any
from uuid import UUID, uuid5

import numpy as np
import pytest

from crkr.protocol import StoredTrial
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.randomness import evaluation_rng

# As the protocol defines it, by hand.
NAMESPACE = uuid5(UUID("6ba7b811-9dad-11d1-80b4-00c04fd430c8"), "crkr/reaching")


@pytest.fixture(scope="module")
def log(finished_run: Any) -> list[StoredTrial]:
    return list(finished_run.task.iter_samples())


@pytest.fixture(scope="module")
def evaluations(log: list[StoredTrial]) -> list[StoredTrial]:
    return [stored for stored in log if stored.trial.kind == "evaluation"]


def test_the_total_of_training_trials_is_exact(finished_run: Any, log: list[StoredTrial]) -> None:
    kinds = Counter(stored.trial.kind for stored in log)
    assert kinds["trial"] + kinds["failed"] == 120 == finished_run.report["trained"] == finished_run.report["trials"]


def test_demonstrations_come_first_and_have_the_ids_of_the_protocol(log: list[StoredTrial]) -> None:
    assert [stored.trial.kind for stored in log[:5]] == ["demonstration"] * 5
    assert [stored.trial.id for stored in log[:5]] == [uuid5(NAMESPACE, f"demo/{index}") for index in range(5)]


def test_evaluation_trials_have_the_ids_of_the_protocol(evaluations: list[StoredTrial]) -> None:
    found = {stored.trial.id: (stored.trial.info["epoch"], stored.trial.info["ball"]) for stored in evaluations}
    assert found == {
        uuid5(NAMESPACE, f"eval/{epoch}/{ball}"): (epoch, ball) for epoch in range(3) for ball in range(10)
    }


@pytest.mark.usefixtures("skills_here")
def test_every_epoch_is_judged_on_the_same_contexts(evaluations: list[StoredTrial]) -> None:
    skill = load_skill("reaching:make", SkillOptions())
    for stored in evaluations:
        expected = skill.reset(evaluation_rng(1, int(stored.trial.info["ball"])))
        np.testing.assert_array_equal(stored.trial.state, expected)


def test_one_model_near_its_boundary_answers_for_an_epoch(evaluations: list[StoredTrial]) -> None:
    for epoch in range(3):
        mine = [stored.trial for stored in evaluations if stored.trial.info["epoch"] == epoch]
        assert len({trial.model_version for trial in mine}) == 1
        assert 50 * epoch <= mine[0].info["trained"] < 50 * (epoch + 1)


def test_the_model_of_epoch_0_knows_the_demonstrations_only(evaluations: list[StoredTrial]) -> None:
    assert {stored.trial.model_version for stored in evaluations if stored.trial.info["epoch"] == 0} == {6}


def test_a_goal_that_was_not_executed_is_a_failed_trial_without_cost(log: list[StoredTrial]) -> None:
    training = [stored.trial for stored in log if stored.trial.kind in ("trial", "failed")]
    assert {trial.info["reason"] for trial in training} <= {"reached", "missed", "out of reach"}
    for trial in training:
        refused = trial.info["reason"] == "out of reach"
        assert (trial.kind == "failed") == refused == (trial.cost is None)


def test_costs_are_those_of_the_skill(log: list[StoredTrial]) -> None:
    turn = math.radians(30.0)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    for stored in log:
        if stored.trial.cost is not None and stored.trial.info["reason"] != "out of reach":
            miss = np.linalg.norm(stored.trial.goal - rotation @ stored.trial.state)
            assert stored.trial.cost == pytest.approx(1.0 - math.exp(-miss))


def test_the_report_agrees_with_the_log(finished_run: Any, evaluations: list[StoredTrial]) -> None:
    for epoch in finished_run.report["epochs"]:
        mine = [stored.trial.info["outcomes"] for stored in evaluations if stored.trial.info["epoch"] == epoch["epoch"]]
        assert epoch["near"] == pytest.approx(np.mean([outcome["near"] for outcome in mine]))
        assert epoch["exact"] == pytest.approx(np.mean([outcome["exact"] for outcome in mine]))


def test_what_is_published_is_what_is_stored(finished_run: Any, log: list[StoredTrial]) -> None:
    stored = {each.trial.id.bytes: each for each in log}
    assert finished_run.telemetry  # some may be lost; if nothing came, nothing was published
    for topic, message in finished_run.telemetry:
        trial = stored[bytes(getattr(message["id"], "bytes", message["id"]))]
        assert message["seq"] == trial.seq
        assert topic == ("evaluation" if trial.trial.kind == "evaluation" else "trial")


def test_the_first_message_of_a_worker_has_the_scene(finished_run: Any, log: list[StoredTrial]) -> None:
    first = {stored.trial.worker: stored.seq for stored in reversed(log)}
    assert len(first) == 3  # demonstrator and two workers
    arrived = [message for _, message in finished_run.telemetry if message["seq"] == first[message["worker"]]]
    assert all("scene" in message for message in arrived)


def test_a_training_message_tells_time_sigma_novelty_and_path(finished_run: Any) -> None:
    training = [message for topic, message in finished_run.telemetry if topic == "trial" and "timing" in message]
    assert all(set(message["timing"]) == {"predict_ms", "execute_ms", "report_ms"} for message in training)
    assert all(0.0 <= message["novelty"] <= 1.0 and message["sigma_mean"] > 0.0 for message in training)
    traces = [message["trace"] for message in training if "trace" in message]
    assert all(list(trace["bodies"]) == ["hand"] for trace in traces)
