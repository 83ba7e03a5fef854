import numpy as np
import pytest

from crkr.sim_worker.table_tennis.ball.flight import Ball, flight
from crkr.sim_worker.table_tennis.ball.incoming import FreeBall, Incoming
from crkr.sim_worker.table_tennis.scene import make_ball_alone

SNAPSHOT = np.array([0.5, 0.1, 1.2, -4.4, 0.1, -0.4])


def test_before_the_bounce_the_ball_only_flies() -> None:
    incoming = Incoming(SNAPSHOT, 1.0)
    assert incoming.bounces[0] > 0.2
    for time in (0.0, 0.013, 0.1, 0.2):
        assert incoming.at(time)[0] == pytest.approx(flight(Ball(*SNAPSHOT), time), abs=1e-7)
        assert incoming.at(time)[1] == pytest.approx(np.zeros(3))


def test_positions_at_many_times_are_those_at_each() -> None:
    incoming, times = Incoming(SNAPSHOT, 0.9), np.linspace(0, 0.9, 137)
    alone = np.array([incoming.at(float(time))[0][:3] for time in times])
    assert np.abs(incoming.positions(times) - alone).max() < 1e-6


def test_it_bounces_on_the_table_with_top_spin() -> None:
    incoming = Incoming(SNAPSHOT, 0.9)
    (time,) = incoming.bounces
    before, after = incoming.at(time - 1e-9), incoming.at(time + 1e-9)
    assert before[0].z == pytest.approx(0.78, abs=1e-6)
    assert after[0].vz == pytest.approx(-0.93 * before[0].vz, rel=1e-6)
    assert abs(after[0].vx) < abs(before[0].vx)
    assert after[1][1] < -50  # flying towards -x, rolling over forwards


def test_beside_the_table_it_falls_past_it() -> None:
    incoming = Incoming(np.array([0.5, 1.0, 1.2, -4.4, 0.1, -0.4]), 0.9)
    assert incoming.bounces == []
    assert incoming.at(0.6)[0].z < 0.7


def test_the_simulated_ball_stays_within_centimetres_of_the_exact_one() -> None:
    """After the bounce: friction makes the soft contact some percent less springy, and its phase matters."""
    rng = np.random.default_rng(0)
    alone, free, apart = make_ball_alone(), FreeBall(), []
    for _ in range(20):
        snapshot = SNAPSHOT + rng.normal(size=6) * [0, 0.1, 0.05, 0.15, 0.1, 0.2]
        exact, simulated = free.path(snapshot, 0.7), alone.path(snapshot, 0.7)
        apart.append(np.linalg.norm(exact[600, :3] - simulated[600, :3]))
    assert np.mean(apart) < 0.07
    assert np.max(apart) < 0.12
