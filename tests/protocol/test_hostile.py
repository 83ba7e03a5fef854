"""Telemetry survives the wire; and any message with one strange part in it is read or refused, never a crash."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import (
    Explanation,
    Geom,
    Invalid,
    Neighbour,
    Prediction,
    PredictRequest,
    Receipt,
    ReportRequest,
    SampleExplanation,
    StoredTrial,
    TaskSpec,
    Trace,
    Trial,
    geoms_from_wire,
    geoms_to_wire,
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
ANSWER = Prediction(np.zeros(2), np.ones(1), np.ones(1), np.ones(1), np.array(0.5), [ID], 1, 1, "mean")


def test_a_trace_and_a_scene_survive_the_wire() -> None:
    rng = np.random.default_rng(0)
    trace = Trace(
        np.arange(4.0),
        ("arm", "ball"),
        rng.normal(size=(4, 2, 3)),
        rng.normal(size=(4, 2, 4)),
        {"ball": np.ones((4, 3))},
    )
    again = Trace.from_wire(unpack(pack({"trace": trace.to_wire()}))["trace"])
    assert again.bodies == trace.bodies
    np.testing.assert_allclose(again.positions, trace.positions, atol=1e-6)
    np.testing.assert_allclose(again.paths["ball"], trace.paths["ball"], atol=1e-6)
    table = Geom("world", "box", (1.0, 0.5, 0.1), (0.0, 0.0, 0.7), (0.0, 0.0, 0.0, 1.0), (0.0, 0.5, 0.0, 1.0))
    assert geoms_from_wire(unpack(pack({"scene": geoms_to_wire([table])}))["scene"]) == (table,)


READERS: list[tuple[Callable[[Any], object], dict[str, Any]]] = [
    (lambda message: PredictRequest.from_wire(message, 2), PredictRequest.create(2, [0, 0], trial_ids=[ID]).to_wire()),
    (lambda message: Prediction.from_wire(message, np.zeros(2)), ANSWER.to_wire()),
    (lambda message: ReportRequest.from_wire(message, SPEC), ReportRequest((Trial.create(SPEC, **GOOD),)).to_wire()),
    (Receipt.from_wire, Receipt(1, 0, (2,), 3).to_wire()),
    (
        lambda message: StoredTrial.from_wire(message, SPEC),
        StoredTrial(Trial.create(SPEC, **GOOD, outcome=[0, 0]), 2, 1.5).to_wire(),
    ),
    (
        Explanation.from_wire,
        Explanation((Neighbour(ID, 1.0, 0.0, 0.0),), 0.0, SampleExplanation(ID, True, True, ID, 0.5)).to_wire(),
    ),
    (
        Trace.from_wire,
        Trace(np.zeros(1), ("a",), np.zeros((1, 1, 3)), np.zeros((1, 1, 4)), {"p": np.zeros((1, 3))}).to_wire(),
    ),
    (
        lambda message: geoms_from_wire(message.get("scene")),
        {"scene": geoms_to_wire([Geom("w", "box", (1, 1, 1), (0, 0, 0), (0, 0, 0, 1), (1, 1, 1, 1))])},
    ),
]
junk: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=4) | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


def mutated(message: Any, path: list[int], value: Any) -> Any:
    """The message with one place in it, chosen by `path`, replaced by `value` or taken out."""
    if path and isinstance(message, dict) and message:
        key = sorted(message)[path[0] % len(message)]
        inner = {**message, key: mutated(message[key], path[1:], value)}
        return {name: entry for name, entry in inner.items() if not (name == key and entry is ...)}
    if path and isinstance(message, list) and message:
        place = path[0] % len(message)
        entries = [*message[:place], mutated(message[place], path[1:], value), *message[place + 1 :]]
        return [entry for entry in entries if entry is not ...]
    return value


@pytest.mark.parametrize("reader", range(len(READERS)))
@given(st.lists(st.integers(0, 20), min_size=1, max_size=4), junk | st.just(...))
def test_a_message_with_one_strange_part_is_read_or_refused(reader: int, path: list[int], value: Any) -> None:
    read, good = READERS[reader]
    wire = mutated(msgpack.unpackb(pack(good)), path, value)
    with suppress(Invalid):  # anything else fails the test
        read(wire)


@pytest.mark.parametrize("reader", range(len(READERS)))
def test_the_unspoilt_message_is_read(reader: int) -> None:
    read, good = READERS[reader]
    read(msgpack.unpackb(pack(good)))
