"""The quick ways to write and read predictions agree with the protocol's own codec, byte for byte."""

from dataclasses import replace
from uuid import UUID

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import Prediction, PredictRequest, pack, unpack
from crkr.protocol.messages.predict_bytes import (
    Question,
    packed_question,
    packed_rows,
    read_answer,
    read_question,
    state_bytes,
)


def prediction(rng: np.random.Generator, shape: tuple[int, ...], p: int, q: int) -> Prediction:
    count = shape[0] if shape else 1
    return Prediction(
        states=rng.normal(size=(*shape, 2)),
        goals=rng.normal(size=(*shape, p)),
        means=rng.normal(size=(*shape, p)),
        sigmas=rng.normal(size=(*shape, p)),
        novelty=np.asarray(rng.uniform(size=shape)),
        trial_ids=[UUID(bytes=rng.bytes(16)) for _ in range(count)],
        model_version=int(rng.integers(2**40)),
        active=int(rng.integers(300)),
        policy="explore",
        predicted_outcome=rng.normal(size=(*shape, q)) if q else None,
        predicted_outcome_sd=rng.normal(size=(*shape, q)) if q else None,
        compute_us=int(rng.integers(100_000)),
        success_probability=np.asarray(rng.uniform(size=shape)),
    )


def row(whole: Prediction, index: int) -> Prediction:
    """One state's part, as the model would give it for that state alone."""

    def part(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else np.asarray(array[index])

    arrays = {name: part(getattr(whole, name)) for name in ("states", "goals", "means", "sigmas", "novelty")}
    arrays["success_probability"] = part(whole.success_probability)
    outcome = {name: part(getattr(whole, name)) for name in ("predicted_outcome", "predicted_outcome_sd")}
    rest = {name: getattr(whole, name) for name in ("model_version", "active", "policy", "compute_us")}
    if whole.corrected is not None:
        rest["policy"] = "corrected" if whole.corrected[index] else "mean"
    return Prediction(trial_ids=[whole.trial_ids[index]], **arrays, **outcome, **rest)  # type: ignore[arg-type]  # a row has no None where the whole has none


@given(st.integers(0, 2**32), st.integers(1, 5), st.integers(1, 40), st.integers(0, 5))
def test_rows_of_a_batch_are_packed_as_single_answers(seed: int, count: int, p: int, q: int) -> None:
    whole = prediction(np.random.default_rng(seed), (count,), p, q)
    ids = [one.bytes for one in whole.trial_ids]
    assert list(packed_rows(whole, ids, whole.compute_us)) == [pack(row(whole, n).to_wire()) for n in range(count)]


@given(st.integers(0, 2**32), st.lists(st.booleans(), min_size=1, max_size=5).filter(any))
def test_each_row_says_whether_its_own_goal_was_corrected(seed: int, flags: list[bool]) -> None:
    drawn = prediction(np.random.default_rng(seed), (len(flags),), 3, 2)
    whole = replace(drawn, policy="corrected", corrected=np.array(flags))
    ids = [one.bytes for one in whole.trial_ids]
    rows = list(packed_rows(whole, ids, whole.compute_us))
    assert rows == [pack(row(whole, n).to_wire()) for n in range(len(flags))]
    assert [unpack(one)["policy"] == "corrected" for one in rows] == flags


@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(0, 5))
def test_an_answer_for_one_state_is_packed_as_itself(seed: int, p: int, q: int) -> None:
    whole = prediction(np.random.default_rng(seed), (), p, q)
    assert list(packed_rows(whole, [whole.trial_ids[0].bytes], whole.compute_us)) == [pack(whole.to_wire())]


@pytest.mark.parametrize(
    "states",
    [
        None,
        [0.0, 1.0],
        {"shape": [3], "dtype": "<f8", "data": bytes(24)},
        {"shape": [1, 2], "dtype": "<f8", "data": bytes(16)},
        {"shape": [2], "dtype": "<f4", "data": bytes(8)},
        {"shape": [2], "dtype": "<f8", "data": bytes(15)},
        {"shape": [2], "dtype": "<f8", "data": "0123456789012345"},
    ],
)
def test_any_other_form_of_states_is_left_to_the_full_check(states: object) -> None:
    assert state_bytes({"states": states}, 2) is None
    assert state_bytes({"states": {"shape": [2], "dtype": "<f8", "data": bytes(16)}}, 2) == bytes(16)


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=70),
    st.booleans(),
    st.binary(min_size=16, max_size=16),
    st.none() | st.text(max_size=128),
)
def test_a_question_is_packed_as_its_map(
    state: list[float], explore: bool, trial_id: bytes, worker: str | None
) -> None:
    asked = PredictRequest.create(len(state), state, explore=explore, trial_ids=[trial_id], worker=worker)
    assert packed_question(asked.states, explore, trial_id, worker) == pack(asked.to_wire())


@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=70),
    st.booleans(),
    st.binary(min_size=16, max_size=16),
    st.none() | st.text(max_size=130),
    st.booleans(),
)
def test_a_question_is_read_as_it_was_packed(
    state: list[float], explore: bool, trial_id: bytes, worker: str | None, right: bool
) -> None:
    payload = packed_question(np.array(state), explore, trial_id, worker)
    found = read_question(payload, len(state) if right else len(state) + 1)
    if right and worker != "" and len(worker or "") <= 128:
        assert found == Question(np.array(state).tobytes(), explore, trial_id, worker)
    else:
        assert found is None


@given(st.data())
def test_a_damaged_question_is_never_read_otherwise_than_by_the_codec(data: st.DataObject) -> None:
    whole = bytearray(packed_question(np.zeros(2), data.draw(st.booleans()), bytes(range(16)), "w"))
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))]) if data.draw(st.booleans()) else bytes(whole)
    found = read_question(damaged, 2)
    if found is not None:
        asked = unpack(damaged)
        assert state_bytes(asked, 2) == found.state
        assert asked["trial_ids"] == [found.trial_id]
        assert (asked.get("explore", False), asked.get("worker")) == (found.explore, found.worker)


@given(st.integers(0, 2**32), st.integers(1, 40))
def test_an_answer_is_read_as_its_map(seed: int, p: int) -> None:
    sent = prediction(np.random.default_rng(seed), (), p, 0)
    found = read_answer(pack(sent.to_wire()), sent.states, p)
    assert found is not None
    assert pack(found.to_wire()) == pack(sent.to_wire())
    assert found.states is sent.states
    for array in (found.goals, found.means, found.sigmas, found.novelty):
        assert array.dtype == np.float64
        assert (array.flags.aligned, array.flags.writeable) == (True, False)
    assert (found.novelty.shape, found.trial_ids, type(found.compute_us)) == ((), sent.trial_ids, int)


@given(st.integers(0, 2**32), st.integers(1, 20), st.integers(1, 20), st.integers(0, 3))
def test_an_answer_of_another_form_is_left_to_the_codec(seed: int, p: int, asked: int, q: int) -> None:
    sent = prediction(np.random.default_rng(seed), (), p, q)
    if (p, 0) != (asked, q):
        assert read_answer(pack(sent.to_wire()), sent.states, asked) is None
    batch = prediction(np.random.default_rng(seed), (1,), p, q)
    assert read_answer(pack(batch.to_wire()), batch.states, p) is None


@given(st.integers(0, 2**32), st.data())
def test_a_damaged_answer_is_never_read_otherwise_than_by_the_codec(seed: int, data: st.DataObject) -> None:
    sent = prediction(np.random.default_rng(seed), (), 3, 0)
    whole = bytearray(pack(sent.to_wire()))
    for _ in range(data.draw(st.integers(1, 3))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))]) if data.draw(st.booleans()) else bytes(whole)
    found = read_answer(damaged, sent.states, 3)
    if found is not None:
        assert pack(found.to_wire()) == pack(Prediction.from_wire(unpack(damaged), sent.states).to_wire())
