from __future__ import annotations

import numpy as np
import pytest
from swing_goals import ARM, HOME, SPEED, WAY, wave

from crkr.protocol.errors import Invalid
from crkr.sim_worker.primitives.stroke import JointTrajectory, Primitive


def test_samples_are_each_others_derivatives_and_agree_with_the_knots() -> None:
    swing = Primitive(ARM, wave(2.0)).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    middle = swing.time[:-1] + 0.4 * np.diff(swing.time)
    shift = 1e-5
    (q0, v0, _), (q1, v1, _) = swing.sample(middle - shift), swing.sample(middle + shift)
    _, velocity, acceleration = swing.sample(middle)
    np.testing.assert_allclose((q1 - q0) / (2 * shift), velocity, atol=1e-8)
    np.testing.assert_allclose((v1 - v0) / (2 * shift), acceleration, atol=1e-8)
    q, qd, qdd = swing.sample(swing.time)
    np.testing.assert_array_equal(q, swing.position)
    np.testing.assert_array_equal(qd[:-1], swing.velocity[:-1])
    np.testing.assert_array_equal(qdd[:-1], swing.acceleration)
    before_knots = swing.sample(np.nextafter(swing.time[1:], 0.0))
    np.testing.assert_allclose(before_knots[0], swing.position[1:], atol=1e-12)
    np.testing.assert_allclose(before_knots[1], swing.velocity[1:], atol=1e-12)


def test_outside_the_swing_the_joints_rest_at_its_ends() -> None:
    swing = Primitive(ARM).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    q, qd, qdd = swing.sample(np.array([9.0, -1.0]))
    np.testing.assert_array_equal(q, [swing.position[-1], HOME])
    assert not qd.any()
    assert not qdd.any()


def test_a_trajectory_keeps_its_own_read_only_arrays() -> None:
    time = np.array([0.0, 1.0])
    swing = JointTrajectory(time, np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((1, 1)))
    time[1] = 7.0
    assert swing.time[1] == 1.0
    assert not any(a.flags.writeable for a in (swing.time, swing.position, swing.velocity, swing.acceleration))
    with pytest.raises(Invalid, match="increasing"):
        JointTrajectory(time[::-1], np.zeros((2, 1)), np.zeros((2, 1)), np.zeros((1, 1)))
