import numpy as np
import pytest

from crkr.sim_worker.table_tennis.arm.wind_up import wind_up


def test_a_wind_up_moves_back_first_and_adds_no_speed_by_the_hit() -> None:
    speeds = np.array([1.0, -2.0, 0.5])
    profile = wind_up(speeds, 0.6)
    velocity = np.cumsum(profile, axis=0) / 25 / 0.6  # [rad/s] at the knots
    assert velocity[24] == pytest.approx(np.zeros(3), abs=1e-12)
    assert (velocity[:24] * speeds < 0).all()
    assert (profile[25:] == 0).all()
