"""Links in a row: where they are, and that their bodies lie between their ends."""

import numpy as np
import pytest

from crkr.protocol import Trace, unpack
from crkr.protocol import pack as packed
from crkr.sim_worker.skill import Chain, Floats


def turned(quaternion: Floats, vector: Floats) -> Floats:
    """A vector turned by a quaternion, scalar last."""
    axis, w = quaternion[:3], quaternion[3]
    return np.asarray(vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector))


def test_a_planar_arm_bends_at_its_joints() -> None:
    arm = Chain({"upper": 0.5, "fore": 0.4})
    bent = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.5, 0.4, 0.0]])
    np.testing.assert_allclose(arm.points([0.0, np.pi / 2]), bent, atol=1e-12)
    assert arm.points(np.zeros((7, 2))).shape == (7, 3, 3)


@pytest.mark.parametrize("seed", range(3))
def test_each_body_lies_from_one_end_to_the_next(seed: int) -> None:
    arm = Chain({"a": 0.5, "b": 0.4, "c": 0.3}, target=0.02)
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(9, 3, 3))
    steps[0, 0], steps[1, 0] = (-1, 0, 0), (1, 0, 0)
    steps *= np.array([0.5, 0.4, 0.3])[:, None] / np.linalg.norm(steps, axis=-1, keepdims=True)
    points = np.concatenate([np.zeros((9, 1, 3)), np.cumsum(steps, axis=1)], axis=1)
    trace = arm.trace(np.arange(9.0), points, [0.2, 0.3])
    assert trace.bodies == ("a", "b", "c", "target")
    for pose in range(9):
        for link, length in enumerate(arm.links.values()):
            end = trace.positions[pose, link] + turned(trace.quaternions[pose, link], np.array([length, 0, 0]))
            np.testing.assert_allclose(end, points[pose, link + 1], atol=1e-9)
    np.testing.assert_array_equal(trace.positions[:, 3], np.broadcast_to([0.2, 0.3, 0.0], (9, 3)))
    assert {shape.body for shape in arm.scene()} == set(trace.bodies)
    assert Trace.from_wire(unpack(packed(trace.to_wire()))).bodies == trace.bodies
