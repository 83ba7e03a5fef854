from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.client.checks import plain
from crkr.dashboard import Telemetry
from crkr.protocol import Geom, Invalid, Trace

Message = Callable[..., dict[str, Any]]


def test_a_message_is_read_with_its_scene_and_its_poses(message: Message, scene: tuple[Geom, ...]) -> None:
    telemetry = Telemetry.from_wire(message(7))
    assert (telemetry.seq, telemetry.worker, telemetry.kind, telemetry.success) == (7, "crane-1", "trial", True)
    assert (telemetry.sigma_mean, telemetry.novelty) == (0.4, 0.75)
    assert telemetry.timing_ms == {"predict": 1.0, "execute": 20.0, "report": 3.0}
    assert telemetry.scene == scene
    assert telemetry.trace is not None
    np.testing.assert_allclose(telemetry.trace.positions[0, 1], [7.3, 7.4, 7.5], rtol=1e-6)
    np.testing.assert_allclose(telemetry.trace.paths["load"], telemetry.trace.positions[:, 1] + 1, rtol=1e-6)


def test_a_message_that_the_client_has_decoded_reads_the_same(message: Message) -> None:
    raw, decoded = Telemetry.from_wire(message(7)), Telemetry.from_wire(plain(message(7)))
    assert raw.scene == decoded.scene
    assert raw.trace is not None
    assert decoded.trace is not None
    np.testing.assert_array_equal(raw.trace.positions, decoded.trace.positions)


def test_what_a_worker_sends_is_what_is_read(message: Message) -> None:
    steps = np.arange(3.0)
    trace = Trace(steps, ("a",), np.ones((3, 1, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (3, 1, 1)), {"a": np.eye(3)})
    read = Telemetry.from_wire(message(1, trace=trace.to_wire())).trace
    assert read is not None
    assert read.bodies == trace.bodies
    np.testing.assert_array_equal(read.positions, trace.positions)


def test_only_the_numbers_are_required(message: Message) -> None:
    short = {name: message(1)[name] for name in ("seq", "worker", "kind", "success")}
    telemetry = Telemetry.from_wire(short)
    assert (telemetry.trace, telemetry.scene, telemetry.sigma_mean, telemetry.novelty) == (None, None, None, None)


def odd_trace(**fields: Any) -> dict[str, Any]:
    flat = {"time": [0.0, 1.0], "bodies": [], "positions": np.zeros((2, 0, 3)), "quaternions": np.zeros((2, 0, 4))}
    return {"trace": flat | fields}


def odd_shape(**fields: Any) -> dict[str, Any]:
    ball = {"body": "a", "shape": "sphere", "size": [1.0, 0.0, 0.0], "position": [0.0, 0.0, 0.0]}
    look = {"quaternion": [0.0, 0.0, 0.0, 1.0], "colour": [1.0, 1.0, 1.0, 1.0]}
    return {"scene": [ball | look | fields]}


@pytest.mark.parametrize(
    "fields",
    [
        {"seq": None},
        {"seq": -4},
        {"seq": 1.5},
        {"worker": 7},
        {"worker": "w" * 1000},
        {"kind": "party"},
        {"success": "yes"},
        {"sigma_mean": float("inf")},
        {"novelty": "high"},
        {"timing": [1.0]},
        {"timing": {"predict_ms": -1.0}},
        {"timing": {f"{index}": 1.0 for index in range(100)}},
        {"trace": 3},
        {"scene": {"a": 1}},
        {"scene": [1, 2]},
        {"scene": [{}] * 2000},
        odd_trace(time=[]),
        odd_trace(time=[1.0, 0.0]),
        odd_trace(time=[0.0, 1e6]),
        odd_trace(time=[0.0, float("nan")]),
        odd_trace(bodies="ab"),
        odd_trace(bodies=[3]),
        odd_trace(positions=np.zeros((2, 1, 3))),
        odd_trace(paths={"ball": np.full((2, 3), 1e300)}),
        odd_trace(paths={"ball": np.zeros((3, 3))}),
        odd_trace(paths=[1]),
        odd_trace(bodies=["a"], positions=np.zeros((2, 1, 3)), quaternions=np.zeros((2, 1, 4))),
        odd_shape(shape="teapot"),
        odd_shape(size=[1e30, 0.0, 0.0]),
        odd_shape(size=[-1.0, 0.0, 0.0]),
        odd_shape(quaternion=[0.0, 0.0, 0.0, 0.0]),
        odd_shape(colour=[1.0, 1.0]),
        odd_shape(position=None),
    ],
)
def test_what_cannot_be_drawn_is_refused(message: Message, fields: dict[str, Any]) -> None:
    with pytest.raises(Invalid):
        Telemetry.from_wire(message(1, **fields))


words = st.text("ab/ \x00é", max_size=5)
numbers = st.booleans() | st.integers(-(2**40), 2**40) | st.floats()
anything = st.recursive(
    st.none() | numbers | words | st.binary(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=4),
    max_leaves=12,
)
fields = st.sampled_from(
    ["seq", "worker", "kind", "success", "sigma_mean", "novelty", "timing", "trace", "scene", "time", "bodies", "paths"]
)


@given(st.dictionaries(fields, anything, max_size=6))
def test_any_message_is_read_or_refused(odd: dict[str, Any]) -> None:
    base = {"seq": 1, "worker": "w", "kind": "trial", "success": True}
    with suppress(Invalid):
        Telemetry.from_wire(msgpack.unpackb(msgpack.packb(base | odd)))
