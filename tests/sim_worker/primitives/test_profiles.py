from __future__ import annotations

import numpy as np
import pytest
from swing_goals import ARM, HOME, SPEED, WAY, wave

from crkr.protocol.errors import Invalid
from crkr.sim_worker.primitives.profiles import demonstrated_profile, wind_up
from crkr.sim_worker.primitives.stroke import Primitive


def test_a_demonstration_gives_back_its_own_motion_at_its_own_goal() -> None:
    demonstrated = Primitive(ARM, wave(2.0)).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    time = np.linspace(0.0, demonstrated.time[-1], 500)
    position, _, _ = demonstrated.sample(time)
    profile = demonstrated_profile(time, position, 0.6)
    np.testing.assert_allclose(profile, demonstrated.acceleration * 0.6**2, atol=2e-4)
    again = Primitive(ARM, profile).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    np.testing.assert_allclose(again.position, demonstrated.position, atol=1e-6)
    zero = Primitive(ARM).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    assert np.abs(zero.position - demonstrated.position).max() > 0.02


def test_a_demonstration_played_slower_is_the_same_motion_in_its_own_time() -> None:
    demonstrated = Primitive(ARM, wave(2.0)).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    profile = demonstrated_profile(demonstrated.time, demonstrated.position, 0.6)
    slow = Primitive(ARM, profile).trajectory(HOME, HOME + WAY, SPEED / 2, 1.2)
    np.testing.assert_allclose(slow.position, demonstrated.position, atol=1e-5)


def test_a_recording_that_stops_after_the_hit_is_braked_to_rest() -> None:
    demonstrated = Primitive(ARM).trajectory(HOME, HOME + WAY, SPEED, 0.6)
    time = np.linspace(0.0, 0.7, 351)
    profile = demonstrated_profile(time, demonstrated.sample(time)[0], 0.6)
    assert np.abs(profile.sum(axis=0)).max() < 0.05 * np.abs(profile).max()
    before_hit = profile[:25] - demonstrated.acceleration[:25] * 0.6**2
    assert np.abs(before_hit).max() < 1e-2
    assert np.abs(profile).max() < 2 * np.abs(demonstrated.acceleration * 0.6**2).max()


@pytest.mark.parametrize(
    ("time", "hit_time"),
    [([0.0, 0.1, 0.2], 0.3), ([0.0, 0.2, 0.1], 0.1), ([-0.1, 0.0, 0.3], 0.2), ([0.0, 0.3], 0.2)],
)
def test_a_recording_without_the_hit_is_invalid(time: list[float], hit_time: float) -> None:
    with pytest.raises(Invalid, match="time must hold"):
        demonstrated_profile(np.array(time), np.zeros((len(time), 2)), hit_time)


def test_a_wind_up_moves_back_first_and_adds_no_speed_by_the_hit() -> None:
    speeds = np.array([1.0, -2.0, 0.5])
    profile = wind_up(speeds, 0.6)
    velocity = np.cumsum(profile, axis=0) / 25 / 0.6  # [rad/s] at the knots
    assert velocity[24] == pytest.approx(np.zeros(3), abs=1e-12)
    assert (velocity[:24] * speeds < 0).all()
    assert (profile[25:] == 0).all()
