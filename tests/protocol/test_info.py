"""Whatever a trial's info may hold reads back equal; all else is refused before anything is stored."""

from collections import OrderedDict
from datetime import datetime
from decimal import Decimal
from enum import Enum
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from crkr.protocol import Invalid, ReportRequest, StoredTrial, TaskSpec, Trial, make_trials, pack, unpack

SPEC = TaskSpec.from_dict(
    {
        "name": "toss",
        "state": [{"name": "x", "low": 0, "high": 1}],
        "goal": [{"name": "a", "low": 0, "high": 1}],
    }
)


class Arm(str, Enum):  # noqa: UP042 - as it is on Python 3.10 too
    LEFT = "left"


def trial(info: Any) -> Trial:
    return Trial.create(SPEC, id=UUID(int=1), state=[0.5], goal=[0.5], cost=0.5, success=True, info=info)


def read_back(info: Any) -> Any:
    """From the client to the server, into its log, and from there to a client."""
    request = pack(ReportRequest((trial(info),)).to_wire())
    [received] = ReportRequest.from_wire(unpack(request), SPEC).trials
    kept = pack(received.info)
    page = unpack(pack({**received.to_wire(), "info": unpack(kept), "seq": 2, "time": 1.0}))
    return StoredTrial.from_wire(page, SPEC).trial.info


def same(given: Any, got: Any) -> bool:
    """Equal, where NaN is NaN, a tuple reads back as a list, and an array as an array."""
    if isinstance(given, np.ndarray):
        if not isinstance(got, np.ndarray) or given.shape != got.shape:
            return False
        return np.array_equal(given, got, equal_nan=True) if given.dtype.kind == "f" else given.tolist() == got.tolist()
    if isinstance(given, dict):
        return isinstance(got, dict) and given.keys() == got.keys() and all(same(given[key], got[key]) for key in given)
    if isinstance(given, list | tuple):
        return isinstance(got, list) and len(given) == len(got) and all(map(same, given, got))
    if isinstance(got, float) and got != got:
        return bool(given != given)
    return bool(given == got) and isinstance(given, bool | np.bool_) == isinstance(got, bool)


PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.binary(max_size=20)
ARRAYS = st_numpy.arrays(
    st_numpy.scalar_dtypes() | st_numpy.unicode_string_dtypes(),
    st_numpy.array_shapes(min_dims=0, max_dims=5, max_side=3),
)
ODD = (
    st.complex_numbers()
    | st.datetimes()
    | st.decimals()
    | st.uuids()
    | st.text(st.characters(categories=["Cs", "Ll"]), max_size=3)
    | ARRAYS
    | st_numpy.from_dtype(np.dtype(np.float32))
    | st_numpy.from_dtype(np.dtype(np.uint64))
)
KEYS = st.text(max_size=3) | st.sampled_from(["shape", "dtype", "data"]) | st.integers(0, 3)
ANYTHING = st.recursive(
    PLAIN | ODD,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3) | st.tuples(inner, inner),
    max_leaves=8,
)


@given(st.dictionaries(KEYS, ANYTHING, max_size=3))
def test_info_is_refused_or_reads_back_equal(info: dict[Any, Any]) -> None:
    try:
        checked = trial(info).info
    except Invalid as error:
        assert error.message.startswith("info")  # noqa: PT017 - either end is right
        return
    got = read_back(info)
    assert same(info, got)
    assert same(dict(checked), got)


@pytest.mark.parametrize(
    "value",
    [
        np.float32(0.1),
        np.uint64(2**63),
        np.array([1.5, np.nan]),
        np.array([[1, 2]], np.uint8),
        np.array([0.1], np.float32),
        np.array([True]),
        np.array(2.0),
        np.zeros((2, 0)),
        np.asfortranarray([[1.0, 2.0], [3.0, 4.0]]),
        2**64 - 1,
        -(2**63),
        float("inf"),
        b"\0" * 16,
        OrderedDict(a=1),
        Arm.LEFT,
        {"shape": "round", "dtype": "x", "data": 1},
        {"shape": [2], "dtype": "<f8", "data": b"too short"},
    ],
)
def test_what_the_wire_can_say_reads_back_equal(value: Any) -> None:
    assert same({"value": value}, read_back({"value": value}))


@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        (np.array([1 + 2j]), r"info\.value must be an array of real numbers; got complex128"),
        (np.array([2**63 + 5], np.uint64), r"info\.value holds numbers of uint64 beyond <i8"),
        (np.array(["1.5"]), r"info\.value must be an array of real numbers"),
        (np.array([None]), r"info\.value must be an array of real numbers; got object"),
        (np.array(["2026-01-01"], "M8[s]"), r"info\.value must be an array of real numbers"),
        (np.ma.masked_equal([1.0, 2.0], 2.0), r"info\.value is a masked array"),
        (np.zeros((1, 1, 1, 1, 1)), r"info\.value must have at most 4 dimensions"),
        ({0: 1.2}, r"info\.value must be a map with text keys; got a key of type int"),
        ([{"torque": {b"k": 1}}], r"info\.value\[0\]\.torque must be a map with text keys"),
        (2**64, r"info\.value must be a whole number of 64 bits"),
        ([10**5000], r"info\.value\[0\] must be a whole number of 64 bits"),
        (1j, r"info\.value cannot be encoded: complex"),
        (UUID(int=3), r"info\.value cannot be encoded: UUID"),
        (datetime(2026, 1, 1), r"info\.value cannot be encoded: datetime"),
        (Decimal(1), r"info\.value cannot be encoded: Decimal"),
        ({1, 2}, r"info\.value cannot be encoded: set"),
        (msgpack.ExtType(1, b""), r"info\.value cannot be encoded: ExtType"),
        ("\ud800", r"info\.value cannot be encoded: it is no Unicode text"),
        ({"shape": [1], "dtype": "<f8", "data": b"\0" * 8}, r"info\.value has the form in which arrays are sent"),
        (np.zeros(20_000), "limit of 16384"),
    ],
)
def test_what_would_be_changed_is_refused_with_its_place(value: Any, complaint: str) -> None:
    with pytest.raises(Invalid, match=complaint):
        trial({"value": value})
    with pytest.raises(Invalid, match=complaint):  # as the learner in this process and an outbox take it
        make_trials(SPEC, state=[0.5], goal=[0.5], cost=0.5, success=True, info={"value": value})


def nested(depth: int) -> Any:
    value: Any = None
    for _ in range(depth - 1):
        value = [value]
    return {"a": value}


def test_info_is_at_most_32_deep() -> None:
    assert read_back(nested(32)) == nested(32)
    for depth in (33, 500, 5000):
        with pytest.raises(Invalid, match=r"info\.a.* is nested more than 32 deep"):
            trial(nested(depth))


def test_shared_parts_end_the_check_as_soon_as_they_are_too_many() -> None:
    value: Any = 0
    for _ in range(30):
        value = [value] * 100
    with pytest.raises(Invalid, match="16384"):
        trial({"a": value})
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(Invalid, match="nested"):
        trial({"a": loop})


@pytest.mark.parametrize(
    ("info", "complaint"),
    [
        ({"a": {b"k": 1}}, r"info\.a keys must be text; got bytes"),
        ({"a": [msgpack.ExtType(5, b"x")]}, r"info\.a\[0\] cannot be encoded: ExtType"),
        ({"a": [msgpack.Timestamp(1)]}, r"info\.a\[0\] cannot be encoded: Timestamp"),
        (nested(400), "nested more than 32 deep"),
        ({"a": "x" * 17_000}, "16384"),
        ([1], "info must be a map"),
    ],
)
def test_a_message_of_another_client_is_held_to_the_same_rules(info: Any, complaint: str) -> None:
    sent = {**unpack(pack(trial(None).to_wire())), "info": info}
    with pytest.raises(Invalid, match=complaint):
        Trial.from_wire(sent, SPEC)


@pytest.mark.parametrize("info", [nested(400), {"a": {b"k": [1]}}, {"a": {"shape": [3], "dtype": "?", "data": b""}}])
def test_rows_that_were_stored_before_the_rules_are_still_read(info: Any) -> None:
    entry = {**trial(None).to_wire(), "info": info, "seq": 2, "time": 1.0}
    assert StoredTrial.from_wire(entry, SPEC).trial.info == info
