"""What is said to fit into a message fits, and little more would."""

from dataclasses import replace
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    MAX_STATES,
    Invalid,
    Prediction,
    PredictRequest,
    TaskSpec,
    check_model_fits,
    error_to_wire,
    most_active,
    most_states,
    most_states_answered,
    pack,
    random_ids,
)
from crkr.protocol.specification.limits import MOST_RECENT


def spec(states: int, goals: int) -> TaskSpec:
    def axes(count: int) -> list[dict[str, Any]]:
        return [{"name": f"x{number}", "low": 0.0, "high": 1.0} for number in range(count)]

    return TaskSpec.from_dict({"name": "wide", "state": axes(states), "goal": axes(goals)})


def prediction(count: int, outputs: int, measured: int) -> Prediction:
    wide, ids = np.zeros((count, outputs)), [UUID(bytes=one) for one in random_ids(count)]
    outcome = np.zeros((count, measured)) if measured else None
    return Prediction(
        wide, wide, wide, wide, np.zeros(count), ids, 2**62, 2**62, "corrected", outcome, outcome, compute_us=2**62,
        success_probability=np.zeros(count),
    )  # fmt: skip


@pytest.mark.parametrize(("outputs", "measured"), [(100, 0), (256, 0), (256, 256), (90, 17)])
def test_as_many_predictions_fit_into_an_answer_as_is_said(outputs: int, measured: int) -> None:
    most = most_states_answered(outputs, measured)
    assert len(pack(prediction(most, outputs, measured).to_wire())) <= MAX_MESSAGE_BYTES
    assert len(pack(prediction(most + 5, outputs, measured).to_wire())) > MAX_MESSAGE_BYTES


@pytest.mark.parametrize(("states", "goals"), [(256, 1), (255, 64), (100, 100)])
def test_as_many_states_fit_into_a_question_as_is_said(states: int, goals: int) -> None:
    most = most_states(spec(states, goals))
    request = PredictRequest(
        np.zeros((most, states)), True, tuple(UUID(bytes=one) for one in random_ids(most)), "\U0001f916" * 128
    )
    assert len(pack(request.to_wire())) <= MAX_MESSAGE_BYTES
    assert most <= most_states_answered(goals, 0)


def test_small_states_are_bounded_by_their_number_alone() -> None:
    assert most_states(spec(6, 13)) == MAX_STATES


@pytest.mark.parametrize(("states", "goals"), [(256, 256), (6, 13), (1, 1)])
def test_a_model_of_as_many_samples_as_is_said_fits_and_no_larger_budget_is_accepted(states: int, goals: int) -> None:
    most = most_active(states, goals)
    model = {
        "states": np.zeros((most, states)),
        "goals": np.zeros((most, goals)),
        "costs": np.zeros(most),
        "ids": random_ids(most),
        "settings": [np.zeros(states)] * 2 + [np.zeros(goals)] * 4,
        "recent": {"states": np.zeros((MOST_RECENT, states)), "success": np.zeros(MOST_RECENT)},
    }
    assert 0.99 * MAX_MESSAGE_BYTES < len(pack(model)) <= MAX_MESSAGE_BYTES - 2048
    check_model_fits(replace(spec(states, goals), budget=most))
    with pytest.raises(Invalid, match=f"at most {most} with") as caught:
        check_model_fits(replace(spec(states, goals), budget=most + 1))
    assert caught.value.details == {"field": "budget", "most": most}


@pytest.mark.parametrize(("states", "goals"), [(100, 100), (6, 13)])
def test_a_model_grows_by_sample_as_is_said(states: int, goals: int) -> None:
    learner = Learner(replace(spec(states, goals), name="n" * 63))
    rng = np.random.default_rng(3)
    recent = rng.uniform(size=(MOST_RECENT, states))
    learner.report(state=recent, goal=np.zeros((MOST_RECENT, goals)), cost=0.5, success=False)
    sizes = []
    for _ in range(2):
        for _ in range(50):
            learner.report(state=rng.uniform(size=states), goal=rng.uniform(size=goals), cost=0.5, success=True)
        sizes.append(len(pack(learner.model.to_wire())))
    each = (sizes[1] - sizes[0]) / 50
    whole = sizes[1] + each * (most_active(states, goals) - 100)
    assert 0.99 * MAX_MESSAGE_BYTES < whole <= MAX_MESSAGE_BYTES


def test_an_error_that_quotes_much_is_cut() -> None:
    told = error_to_wire(Invalid("é" * 9_000_000))
    assert len(told["message"]) == 4096
    assert told["message"].endswith("é ...")


def test_parts_of_a_prediction_are_joined_in_order_under_the_oldest_version() -> None:
    rng = np.random.default_rng(1)
    ids = [UUID(bytes=one) for one in random_ids(5)]
    rows = {name: rng.normal(size=(5, 2)) for name in ("states", "goals", "means", "sigmas", "predicted_outcome")}
    novelty = rng.uniform(size=5)

    def part(start: int, end: int, version: int, policy: str, outcome: bool = True) -> Prediction:
        states, goals, means, sigmas, predicted = (array[start:end] for array in rows.values())
        told = predicted if outcome else None
        return Prediction(
            states,
            goals,
            means,
            sigmas,
            novelty[start:end],
            ids[start:end],
            version,
            version + 1,
            policy,
            told,
            told,
            7,
        )

    joined = Prediction.joined([part(0, 2, 9, "mean"), part(2, 3, 8, "corrected"), part(3, 5, 9, "mean")])
    for name, array in rows.items():
        np.testing.assert_array_equal(getattr(joined, name), array)
        assert not getattr(joined, name).flags.writeable
    np.testing.assert_array_equal(joined.novelty, novelty)
    assert joined.trial_ids == ids
    assert (joined.model_version, joined.active, joined.policy, joined.compute_us) == (8, 9, "corrected", 21)
    assert joined.corrected is None
    assert Prediction.joined([part(0, 3, 1, "mean"), part(3, 5, 2, "mean", False)]).predicted_outcome is None
