"""Bytes and back: what goes in comes out, and whatever else comes in is refused and does no harm."""

import struct
from collections.abc import Callable
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    Invalid,
    Unsupported,
    array_from_wire,
    array_to_wire,
    check_encoding,
    encoding,
    id_from_wire,
    pack,
    unpack,
)
from crkr.protocol.codec import MAX_DEPTH, unpack_request

shapes = hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)
finite_lists = st.recursive(
    st.floats(allow_nan=False) | st.integers(-(2**53), 2**53), lambda inner: st.lists(inner, max_size=4), max_leaves=12
)
anything = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=8) | st.binary(),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["shape", "dtype", "data", "x"]), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(hnp.arrays(st.sampled_from(["<f8", "<f4", "<i8", ">f8", "<i2"]), shapes))
def test_an_array_survives_the_wire_bit_by_bit(array: np.ndarray[Any, Any]) -> None:
    received = array_from_wire(unpack(pack({"a": array}))["a"], "a")
    assert received.dtype == np.float64
    assert received.shape == array.shape
    np.testing.assert_array_equal(received, array.astype(np.float64))


def test_an_array_is_little_endian_with_the_last_index_fastest() -> None:
    wire = array_to_wire(np.asfortranarray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    assert wire == {"shape": [2, 3], "dtype": "<f8", "data": struct.pack("<6d", 1, 2, 3, 4, 5, 6)}
    assert array_to_wire(np.array([7]))["data"] == struct.pack("<q", 7)


@given(st.lists(st.lists(st.floats(allow_nan=False), min_size=2, max_size=2), min_size=1, max_size=5))
def test_nested_lists_say_the_same_as_an_array_map(rows: list[list[float]]) -> None:
    np.testing.assert_array_equal(
        array_from_wire(rows, "a"), array_from_wire(unpack(pack({"a": np.array(rows)}))["a"], "a")
    )


def test_null_in_a_list_is_not_a_number() -> None:
    np.testing.assert_array_equal(array_from_wire([1, None], "a"), [1.0, np.nan])


@given(
    st.dictionaries(
        st.text(max_size=5), st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.text(), max_size=5
    )
)
def test_plain_messages_come_back_as_they_went(message: dict[str, Any]) -> None:
    assert unpack(pack(message)) == message


@given(st.binary(max_size=200))
def test_random_bytes_are_a_message_or_refused(data: bytes) -> None:
    try:
        message = unpack(data)
    except Invalid:
        return
    assert all(isinstance(key, str) for key in message)


@given(anything)
def test_whatever_stands_for_an_array_is_read_or_refused(value: Any) -> None:
    try:
        array = array_from_wire(value, "a")
    except Invalid:
        return
    assert array.dtype == np.float64
    assert array.flags.owndata or array.base is not None


@pytest.mark.parametrize(
    "value",
    [
        {"shape": [2], "dtype": "<f8", "data": b"\0" * 15},
        {"shape": [2**62, 2**62], "dtype": "<f8", "data": b""},
        {"shape": [-1], "dtype": "<f8", "data": b""},
        {"shape": [True], "dtype": "<f8", "data": b"\0" * 8},
        {"shape": [1] * 5, "dtype": "<f8", "data": b"\0" * 8},
        {"shape": [1], "dtype": "|O8", "data": b"\0" * 8},
        {"shape": [1], "dtype": ">f8", "data": b"\0" * 8},
        {"shape": [1], "dtype": "<f8", "data": "12345678"},
        {"shape": [1], "dtype": "<f8"},
        [[1, 2], [3]],
        [[[1]]],
        [True],
        ["1"],
        True,
        "1",
        None,
    ],
)
def test_an_array_whose_parts_disagree_is_refused(value: Any) -> None:
    with pytest.raises(Invalid, match="states"):
        array_from_wire(value, "states")


@pytest.mark.parametrize(
    "data",
    [
        b"\xc1",
        b"\x93\x01\x02\x03",
        b"\x81\x01\x02",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\x91" * 5000,
        b"\x81\xa1a" * 2000 + b"\x01",
        b"\x81\xa1a\x01\x00",
        b"\x81\xa2\xff\xfe\x01",
        b"\0" * (MAX_MESSAGE_BYTES + 1),
    ],
)
def test_hostile_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(Invalid):
        unpack(data)


def test_no_bytes_are_an_empty_message() -> None:
    assert unpack(b"") == {}


@pytest.mark.parametrize("value", [object(), {1, 2}, 1j, 2**70, np.array([object()]), "\ud800"])
def test_what_is_no_plain_data_is_not_sent(value: Any) -> None:
    with pytest.raises(Invalid, match="cannot be encoded"):
        pack({"value": value})


@given(st.uuids())
def test_an_id_is_its_sixteen_bytes(identifier: UUID) -> None:
    assert msgpack.unpackb(pack({"id": identifier}))["id"] == identifier.bytes
    assert id_from_wire(identifier.bytes) == identifier == id_from_wire(identifier)


@pytest.mark.parametrize("value", [b"", b"\0" * 15, b"\0" * 17, "0" * 16, 5, None])
def test_what_is_no_id_is_refused(value: Any) -> None:
    with pytest.raises(Invalid, match="16 bytes"):
        id_from_wire(value)


@pytest.mark.parametrize(
    "text", ["", "zenoh/bytes", "application/msgpack", encoding("predict"), encoding("create_task")]
)
def test_this_versions_encodings_are_accepted(text: str) -> None:
    check_encoding(text)


@pytest.mark.parametrize(
    "text",
    ["application/json", "application/msgpack;crkr.predict.v2", "application/msgpack;predict", "x" + encoding("a")],
)
def test_other_encodings_are_unsupported(text: str) -> None:
    with pytest.raises(Unsupported, match="is not offered"):
        check_encoding(text)


@pytest.mark.parametrize("wrap", [lambda inner: [inner], lambda inner: {"a": inner}])
def test_a_message_is_nested_as_deep_as_the_limit_and_no_deeper(wrap: Callable[[object], object]) -> None:
    def nested(depth: int) -> bytes:
        value: object = 1
        for _ in range(depth - 1):
            value = wrap(value)
        return pack({"a": value})

    unpack(nested(MAX_DEPTH))
    for depth in (MAX_DEPTH + 1, 300):
        with pytest.raises(Invalid, match="nested more than 64 deep"):
            unpack(nested(depth))
        unpack(nested(depth), depth=None)  # as what was stored before there was a limit


def padded(value: bytes) -> bytes:
    """A map with this value and enough other bytes to be decoded in slices."""
    return b"\x82\xa1x" + value + b"\xa1y\xc6" + (200_000).to_bytes(4, "big") + bytes(200_000)


@given(st.recursive(st.none() | st.booleans() | st.integers(0, 2**60) | st.text() | st.binary(), st.lists))
def test_a_large_request_says_the_same_in_slices(value: Any) -> None:
    data = padded(msgpack.packb(value))
    assert unpack_request(data) == unpack(data)


@pytest.mark.parametrize(
    "data",
    [
        padded(b"\xc1"),
        padded(b"\x81\x01\x02"),
        padded(b"\x91" * 100 + b"\xc0"),
        padded(b"\xc0")[:-1],
        padded(b"\xc0") + b"\xc0",
        b"\xc6" + (200_000).to_bytes(4, "big") + bytes(200_000),
        bytes(MAX_MESSAGE_BYTES + 1),
    ],
)
def test_a_large_request_is_refused_as_a_small_one_is(data: bytes) -> None:
    with pytest.raises(Invalid):
        unpack(data)
    with pytest.raises(Invalid):
        unpack_request(data)


@pytest.mark.parametrize("entry", [b"\x80", b"\x90", b"\x91\x80", b"\x81\xa0\xc0"])
@pytest.mark.parametrize("length", [60_000, 1000])
def test_a_request_of_very_many_maps_and_lists_is_refused(entry: bytes, length: int) -> None:
    rows = 200_000 // length
    data = padded(b"\xdc" + rows.to_bytes(2, "big") + (b"\xdc" + length.to_bytes(2, "big") + entry * length) * rows)
    assert len(unpack(data)["x"]) == rows
    with pytest.raises(Invalid, match="more than 131072 maps and lists"):
        unpack_request(data)
