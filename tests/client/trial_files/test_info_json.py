"""Whatever msgpack carries in a trial's info comes back from its JSON."""

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.client.trial_files.info_json import info_from_json, info_to_json
from crkr.protocol import Invalid, pack, unpack

LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=20)
)
KEYS = st.sampled_from(["a", "epoch", "$msgpack", "", "é"])
DATA = st.recursive(LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3))


@given(st.dictionaries(KEYS, DATA, max_size=4))
def test_info_comes_back_the_same_to_the_byte(info: dict[str, Any]) -> None:
    text = info_to_json(info)
    assert "\n" not in text
    assert pack(info_from_json(text)) == pack(unpack(pack(info)))


def test_plain_data_is_plain_json() -> None:
    info = {"epoch": 3, "reason": "net", "outcomes": {"paper": True, "strict": None}, "x": [1.5, -0.0]}
    assert json.loads(info_to_json(info)) == info


def test_what_json_cannot_say_is_still_strict_json() -> None:
    text = info_to_json({"x": math.inf, "id": b"\0" * 16})
    assert json.loads(text, parse_constant=pytest.fail).keys() == {"x", "id"}


@pytest.mark.parametrize("text", ["[1]", "{", '"x"', '{"a": {"$msgpack": "?"}}', '{"a": {"$msgpack": "AAAA"}}', "nope"])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(Invalid):
        info_from_json(text)
