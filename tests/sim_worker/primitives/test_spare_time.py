"""How early a goal could be met, against motions that are quickest by construction and against the swings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.sim_worker.primitives.joint_motion import spare_time
from crkr.sim_worker.primitives.stroke import Infeasible, JointLimits, Primitive

LIMITS = JointLimits(np.full(1, -50.0), np.full(1, 50.0), np.array([2.0]), np.array([20.0]))
HIT_TIMES = st.floats(0.2, 1.0)
SPEEDS = st.floats(-1.99, 1.99)


def _spare(way: float, velocity: float, hit_time: float) -> float:
    return spare_time(LIMITS, np.array([way]), np.array([velocity]), hit_time)


@given(
    side=st.sampled_from([-1.0, 1.0]), peak=st.floats(0.05, 1.0), end=st.floats(-1.0, 1.0), cruise=st.floats(0.0, 0.5)
)
def test_the_quickest_motion_has_no_time_to_spare(side: float, peak: float, end: float, cruise: float) -> None:
    """Full acceleration to `peak`, at the speed limit a cruise, full braking to a part of the peak."""
    top, most = 2.0 * peak, 20.0
    cruise = cruise if peak == 1.0 else 0.0
    last = end * top
    braking = (top - last) / most
    way = top**2 / (2 * most) + top * cruise + (top + last) / 2 * braking
    time = top / most + cruise + braking
    assert _spare(side * way, side * last, time) == pytest.approx(0.0, abs=1e-6)
    assert _spare(side * way, side * last, time + 0.1) == pytest.approx(0.1, abs=1e-6)


@given(way=st.floats(-2.0, 2.0), velocity=SPEEDS, hit_time=HIT_TIMES)
def test_no_swing_is_made_without_time_to_spare(way: float, velocity: float, hit_time: float) -> None:
    """Between the knots of a swing acceleration is constant, which costs up to an interval or two."""
    spare = _spare(way, velocity, hit_time)
    try:
        Primitive(LIMITS).trajectory(np.zeros(1), np.array([way]), np.array([velocity]), hit_time)
    except Infeasible:
        assert spare < 2 * hit_time / 25
    else:
        assert spare > -1e-5


def test_the_slowest_joint_counts() -> None:
    both = JointLimits(np.full(2, -50.0), np.full(2, 50.0), np.array([2.0, 1.0]), np.full(2, 20.0))
    assert spare_time(both, np.array([0.4, 0.4]), np.zeros(2), 0.6) == pytest.approx(0.6 - 0.4 - 0.05)
