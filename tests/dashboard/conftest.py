"""A small task of a made-up machine, its trials, what a worker publishes about them, and a server that has it."""

from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
import zenoh
from processes import RunningServer

from crkr.client import Client, Task
from crkr.protocol import Geom, StoredTrial, TaskSpec, Trial, geoms_to_wire

SPEC = {
    "name": "crane",
    "description": "Lift loads.",
    "state": [{"name": "load", "unit": "kg", "low": 0.0, "high": 10.0}],
    "goal": [{"name": "swing", "unit": "rad", "low": -1.0, "high": 1.0}],
}

Make = Callable[..., StoredTrial]
Message = Callable[..., dict[str, Any]]


@pytest.fixture
def spec() -> TaskSpec:
    return TaskSpec.from_dict(SPEC)


@pytest.fixture
def stored(spec: TaskSpec) -> Make:
    """Makes trial number `seq` of the log."""

    def make(seq: int, kind: str = "trial", **fields: Any) -> StoredTrial:
        values: dict[str, Any] = {"cost": 0.5, "success": True, "worker": "crane-1", "info": {}} | fields
        trial = Trial.create(spec, id=UUID(int=seq), state=[5.0], goal=[0.25], kind=kind, **values)
        return StoredTrial(trial, seq, 1000.0 + seq)

    return make


def array_map(values: Any, dtype: str = "<f8") -> dict[str, Any]:
    """An array as the protocol's description has it on the wire."""
    data = np.ascontiguousarray(values, dtype=dtype)
    return {"shape": list(data.shape), "dtype": dtype, "data": data.tobytes()}


@pytest.fixture
def scene() -> tuple[Geom, ...]:
    upright = (0.0, 0.0, 0.0, 1.0)
    grey = (0.5, 0.5, 0.5, 1.0)
    return (
        Geom("world", "box", (2.0, 1.0, 0.1), (0.0, 0.0, -0.1), upright, grey),
        Geom("world", "box", (20.0, 20.0, 0.01), (0.0, 0.0, -0.3), upright, grey),
        Geom("boom", "capsule", (0.05, 0.5, 0.0), (0.0, 0.0, 0.5), upright, grey),
        Geom("boom", "cylinder", (0.1, 0.02, 0.0), (0.0, 0.0, 0.0), upright, grey),
        Geom("hook", "sphere", (0.03, 0.0, 0.0), (0.0, 0.0, 0.0), upright, grey),
    )


@pytest.fixture
def message(scene: tuple[Geom, ...]) -> Message:
    """Makes what a worker publishes about trial number `seq`: two bodies and a path over a tenth of a second."""

    def make(seq: int, /, **fields: Any) -> dict[str, Any]:
        steps = 4
        time = np.linspace(0.0, 0.1, steps)
        positions = np.arange(steps * 2 * 3, dtype=float).reshape(steps, 2, 3) / 10 + seq
        trace = {
            "time": array_map(time),
            "bodies": ["boom", "hook"],
            "positions": array_map(positions, "<f4"),
            "quaternions": array_map(np.tile([0.0, 0.0, 0.0, 1.0], (steps, 2, 1)), "<f4"),
            "paths": {"load": array_map(positions[:, 1] + 1.0, "<f4")},
        }
        return {
            "id": UUID(int=seq).bytes,
            "seq": seq,
            "kind": "trial",
            "state": array_map([5.0]),
            "goal": array_map([0.25]),
            "cost": 0.5,
            "success": True,
            "worker": "crane-1",
            "model_version": 1,
            "info": {"reason": "lifted"},
            "sigma": array_map([0.2]),
            "sigma_mean": 0.4,
            "novelty": 0.75,
            "timing": {"predict_ms": 1.0, "execute_ms": 20.0, "report_ms": 3.0},
            "time": 1000.0,
            "trace": trace,
            "scene": geoms_to_wire(scene),
        } | fields

    return make


@pytest.fixture
def crane(server: RunningServer, spec: TaskSpec) -> Iterator[Task]:
    """The task at a real server."""
    with Client(server.endpoint) as client:
        yield client.create_task(spec)


@pytest.fixture
def publish(server: RunningServer) -> Iterator[Callable[[str, dict[str, Any]], None]]:
    """Publishes as any language could: plain Zenoh and msgpack; the first call waits until somebody subscribes."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{server.endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        publishers: dict[str, zenoh.Publisher] = {}

        def send(topic: str, fields: dict[str, Any]) -> None:
            if topic not in publishers:
                publishers[topic] = session.declare_publisher(f"crkr/@v1/task/crane/pub/{topic}")
            publishers[topic].put(
                msgpack.packb(fields, use_bin_type=True), encoding=f"application/msgpack;crkr.{topic}.v1"
            )

        yield send
