"""Trials, reports, predictions and explanations: checked at the edge, equal after the wire, refused when hostile."""

from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import (
    KINDS,
    MAX_STATES,
    MAX_TRIALS,
    Explanation,
    Invalid,
    Neighbour,
    Prediction,
    PredictRequest,
    ReportRequest,
    SampleExplanation,
    TaskSpec,
    Trial,
    pack,
    unpack,
)

SPEC = TaskSpec.from_dict(
    {
        "name": "throw",
        "state": [{"name": "x", "low": 0, "high": 1}, {"name": "y", "low": 0, "high": 1}],
        "goal": [{"name": "g", "low": -1, "high": 2}],
        "outcome": [{"name": "o", "tolerance": 0.1}, {"name": "u", "tolerance": 0.1}],
    }
)
ID = UUID(int=77)
GOOD: dict[str, Any] = {"id": ID, "state": [0.5, 9.0], "goal": [2.0], "cost": 1.0, "success": True}
reals = st.floats(allow_nan=False, allow_infinity=False)
trials = st.builds(
    lambda state, goal, cost, success, kind, outcome, info: Trial.create(
        SPEC,
        id=uuid4(),
        state=state,
        goal=[goal],
        cost=None if kind == "failed" else cost,
        success=success and kind != "failed",
        kind=kind,
        outcome=outcome,
        info=info,
    ),
    st.lists(reals, min_size=2, max_size=2),
    st.floats(-1, 2),
    st.floats(0, 1),
    st.booleans(),
    st.sampled_from(KINDS),
    st.none() | st.lists(reals | st.just(float("nan")), min_size=2, max_size=2),
    st.dictionaries(st.text(max_size=3), st.integers(0, 9) | st.text(max_size=3), max_size=3),
)


@given(trials)
def test_a_trial_is_bitwise_the_same_after_the_wire(trial: Trial) -> None:
    again = Trial.from_wire(unpack(pack(trial.to_wire())), SPEC)
    assert (again.id, again.kind, again.success, again.cost, again.info) == (
        trial.id, trial.kind, trial.success, trial.cost, trial.info,
    )  # fmt: skip
    assert again.state.tobytes() == trial.state.tobytes()
    assert again.goal.tobytes() == trial.goal.tobytes()
    assert again.digest() == trial.digest()


@given(trials, trials)
def test_two_digests_are_equal_exactly_when_the_contents_are(one: Trial, other: Trial) -> None:
    def content(trial: Trial) -> tuple[Any, ...]:
        outcome = None if trial.outcome is None else trial.outcome.tobytes()
        cost = None if trial.cost is None else np.float64(trial.cost).tobytes()
        return trial.state.tobytes(), trial.goal.tobytes(), cost, trial.success, trial.kind, outcome

    assert (one.digest() == other.digest()) == (content(one) == content(other))


@pytest.mark.parametrize(
    "change",
    [
        {"state": [0.5, np.nextafter(9.0, 10)]},
        {"goal": [1.9]},
        {"cost": np.nextafter(1.0, 0)},
        {"success": False},
        {"kind": "evaluation"},
        {"outcome": [0.0, 0.0]},
        {"outcome": [np.nan, np.nan]},
        {"state": [0.5, -0.0]},
    ],
)
def test_the_least_other_content_is_another_digest(change: dict[str, Any]) -> None:
    assert Trial.create(SPEC, **{**GOOD, **change}).digest() != Trial.create(SPEC, **GOOD).digest()


def test_provenance_is_not_content_and_every_nan_is_one() -> None:
    plain = Trial.create(SPEC, **GOOD, outcome=[1.0, np.nan])
    odd = np.array([0x7FF8000000000001], dtype=np.uint64).view(np.float64)[0]
    other = {**GOOD, "id": uuid4()}
    marked = Trial.create(SPEC, **other, outcome=[1.0, odd], worker="w", model_version=3, info={"a": 1})
    assert plain.digest() == marked.digest()
    assert Trial.create(SPEC, **GOOD, outcome=[1.0, None]).digest() == plain.digest()


BAD: list[tuple[dict[str, Any], str]] = [
    ({"state": [0.5]}, r"shape \(2,\)"),
    ({"state": [0.5, float("nan")]}, "finite"),
    ({"state": ["0.5", "1"]}, "array of numbers"),
    ({"goal": [2.0001]}, r"in \[-1.0, 2.0\]"),
    ({"goal": [[1.0]]}, "shape"),
    ({"cost": 1.1}, "cost"),
    ({"cost": -1e-5}, "cost"),
    ({"cost": float("nan")}, "cost"),
    ({"cost": True}, "cost"),
    ({"cost": None}, "failed"),
    ({"success": 1}, "success"),
    ({"kind": "guess"}, "demonstration"),
    ({"kind": "failed"}, "cannot be a success"),
    ({"id": b"short"}, "16 bytes"),
    ({"outcome": [1.0]}, "outcome"),
    ({"outcome": [1.0, float("inf")]}, "outcome"),
    ({"worker": "w" * 129}, "worker"),
    ({"model_version": -1}, "model_version"),
    ({"info": [1]}, "info"),
    ({"info": {1: 2}}, "info"),
    ({"info": {"a": "x" * 20_000}}, "16384"),
    ({"info": {"a": object()}}, "cannot be encoded"),
]


@pytest.mark.parametrize(("change", "message"), BAD)
def test_a_bad_trial_is_refused_with_the_reason(change: dict[str, Any], message: str) -> None:
    with pytest.raises(Invalid, match=message):
        Trial.create(SPEC, **{**GOOD, **change})


def test_an_unusual_state_is_no_error() -> None:
    assert Trial.create(SPEC, **{**GOOD, "state": [-1e6, 1e6]}).state[1] == 1e6


def test_the_caller_keeps_no_hold_on_a_trials_arrays() -> None:
    state = np.array([0.5, 0.5])
    trial = Trial.create(SPEC, **{**GOOD, "state": state})
    state[0] = 9.0
    assert trial.state[0] == 0.5
    with pytest.raises(ValueError, match="read-only"):
        trial.state[0] = 1.0


def test_a_report_says_which_trial_is_wrong() -> None:
    good = unpack(pack(Trial.create(SPEC, **GOOD).to_wire()))
    with pytest.raises(Invalid, match=r"trials\[1\]: cost") as caught:
        ReportRequest.from_wire({"trials": [good, {**good, "cost": 3}]}, SPEC)
    assert caught.value.details == {"field": "cost", "trial": 1}
    for count in (0, MAX_TRIALS + 1):
        with pytest.raises(Invalid, match=f"1 to {MAX_TRIALS}"):
            ReportRequest.from_wire({"trials": [good] * count}, SPEC)


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([0.1], "shape"),
        ([[0.1, 0.2], [0.3]], "regular"),
        (np.zeros((0, 2)), f"1 to {MAX_STATES}"),
        (np.zeros((MAX_STATES + 1, 2)), f"1 to {MAX_STATES}"),
        (np.zeros((1, 1, 2)), "shape"),
        ([float("inf"), 0], "finite"),
        ("ab", "array of numbers"),
        (None, "shape|finite"),
    ],
)
def test_states_of_another_shape_are_refused(states: Any, message: str) -> None:
    with pytest.raises(Invalid, match=message):
        PredictRequest.create(2, states)


@pytest.mark.parametrize("ids", [[ID], [ID, ID], [ID, uuid4(), uuid4()], ID, "ids", [1, 2]])
def test_trial_ids_are_one_a_state_and_all_different(ids: Any) -> None:
    with pytest.raises(Invalid, match="trial_ids"):
        PredictRequest.create(2, np.zeros((2, 2)), trial_ids=ids)


def test_an_answer_of_one_reads_well_and_a_batch_has_no_single_id() -> None:
    one = Prediction(np.zeros(2), np.ones(1), np.ones(1), np.ones(1), np.array(0.5), [ID], 1, 1, "mean")
    assert one.goal is one.goals
    assert one.mean is one.means
    assert one.sigma is one.sigmas
    assert one.state is one.states
    assert one.trial_id == ID
    again = Prediction.from_wire(unpack(pack(one.to_wire())), one.states)
    assert again.predicted_outcome is None
    assert not again.goals.flags.writeable
    ones = np.ones((2, 1))
    many = Prediction(np.zeros((2, 2)), ones, ones, ones, np.ones(2), [ID, uuid4()], 1, 1, "mean")
    with pytest.raises(Invalid, match="trial_ids"):
        _ = many.trial_id


@pytest.mark.parametrize("sample", [None, SampleExplanation(ID, False, False, None, None)])
def test_an_explanation_survives_the_wire(sample: SampleExplanation | None) -> None:
    answer = Explanation((Neighbour(ID, -0.5, 0.25, 1.5),), 0.75, sample)
    assert Explanation.from_wire(unpack(pack(answer.to_wire()))) == answer
