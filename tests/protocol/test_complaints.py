"""A complaint names what is wrong in a few words, however large or deep the value is that came in its place."""

from collections.abc import Callable
from typing import Any

import pytest

from crkr.protocol import (
    CrkrError,
    Invalid,
    TaskSpec,
    Unsupported,
    array_from_wire,
    check_encoding,
    check_name,
    id_from_wire,
)
from crkr.protocol.checks import choice, finite_array, flag, integer, number, shown, text
from crkr.protocol.codec import pack
from crkr.protocol.keys import split_key


def deep() -> Any:
    value: Any = []
    for _ in range(100_000):
        value = [value]
    return value


VALUES = {
    "deep": deep(),
    "deep in a map": {"a": deep()},
    "long text": "x" * 10**6,
    "long number": 10**5000,
    "long bytes": b"\x1b" * 10**6,
    "long list": [0] * 10**6,
}
SPEC: dict[str, Any] = {
    "name": "toss",
    "state": [{"name": "x", "low": 0, "high": 1}],
    "goal": [{"name": "a", "low": 0, "high": 1}],
}
READERS: dict[str, Callable[[Any], object]] = {
    "text": lambda value: text(value, "worker", longest=9),
    "choice": lambda value: choice(value, "kind", ("trial",)),
    "flag": lambda value: flag(value, "success"),
    "integer": lambda value: integer(value, "seed"),
    "number": lambda value: number(value, "cost"),
    "array": lambda value: finite_array(value, "state", (1,)),
    "array map": lambda value: array_from_wire({"shape": [1], "dtype": value, "data": b""}, "state"),
    "shape": lambda value: array_from_wire({"shape": value, "dtype": "<f8", "data": b""}, "state"),
    "id": id_from_wire,
    "name": check_name,
    "key": lambda value: split_key(str(type(value)) * 10**5),
    "temperature": lambda value: TaskSpec.from_dict({**SPEC, "exploration": {"temperature": {"a": value}}}),
    "encoding": lambda value: check_encoding("application/msgpack;crkr.predict.v" + str(type(value)) * 5000),
    "message": lambda value: pack({"a": {1j: value, "b": value}, "c": 1j}),
}


@pytest.mark.parametrize("value", VALUES)
@pytest.mark.parametrize("reader", READERS)
def test_a_complaint_is_short_whatever_came(reader: str, value: str) -> None:
    with pytest.raises(CrkrError) as caught:
        READERS[reader](VALUES[value])
    assert len(caught.value.message) < 400
    assert len(repr(caught.value.details)) < 400


@pytest.mark.parametrize("value", VALUES)
def test_a_message_shows_any_value_in_a_few_words(value: str) -> None:
    assert 0 < len(shown(VALUES[value])) <= 80


def test_a_version_of_thousands_of_digits_is_not_offered() -> None:
    with pytest.raises(Unsupported, match="is not offered"):
        check_encoding("application/msgpack;crkr.predict.v" + "9" * 5000)


def test_a_short_value_is_shown_as_it_is() -> None:
    assert [shown(value) for value in ("two", 0.5, None, [1, "a"])] == ["'two'", "0.5", "None", "[1, 'a']"]


def test_an_array_of_other_things_than_numbers_names_one() -> None:
    with pytest.raises(Invalid, match="'a' is not a number"):
        finite_array([1, "a", None], "state", (3,))
