import numpy as np
import pytest

from crkr.sim_worker.table_tennis.ball.flight import Ball, flight, fly, fly_to_x
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS, snapshot_of


@pytest.mark.parametrize("name", ["nominal", "medium", "wide"])
def test_snapshots_have_the_stated_centre_and_spread(name: str) -> None:
    launcher, rng = LAUNCHERS[name], np.random.default_rng(7)
    drawn = np.array([launcher.draw(rng) for _ in range(600)])
    assert (drawn[:, 0] == 0.5).all()
    spread = np.array(launcher.spread[1:])
    assert np.abs(drawn[:, 1:].mean(axis=0) - launcher.centre[1:]).max() < 0.2 * spread.max()
    assert (np.abs(drawn[:, 1:].mean(axis=0) - launcher.centre[1:]) < 0.15 * spread).all()
    assert drawn[:, 1:].std(axis=0) == pytest.approx(spread, rel=0.1)


@pytest.mark.parametrize("name", ["nominal", "wide"])
def test_every_ball_clears_the_net_and_bounces_on_the_robots_side(name: str) -> None:
    rng = np.random.default_rng(3)
    for _ in range(100):
        ball = Ball(*LAUNCHERS[name].draw(rng).tolist())
        over = fly_to_x(ball, 0.0)
        assert over is not None
        assert over[1].z > 0.76 + 0.1525 + 0.02
        down = ball
        while down.z > 0.78:
            down = fly(down, 0.005)
        assert -1.37 < down.x < 0
        assert abs(down.y) < 0.7625


def test_a_launch_is_the_snapshots_past() -> None:
    launch = Ball(1.3, 0.1, 1.1, -5.0, 0.1, 1.3)
    snapshot = snapshot_of(launch)
    assert snapshot is not None
    reached = fly_to_x(launch, 0.5)
    assert reached is not None
    assert flight(launch, reached[0]) == pytest.approx(snapshot, abs=1e-7)


@pytest.mark.parametrize(
    "launch",
    [
        Ball(1.3, 0.0, 1.1, 2.0, 0.0, 1.0),  # flies away
        Ball(1.3, 0.0, 1.1, -1.0, 0.0, 0.0),  # falls before the snapshot plane
        Ball(1.3, 0.0, 0.9, -5.0, 0.0, 0.0),  # into the net
        Ball(1.3, 0.0, 1.2, -9.0, 0.0, 1.5),  # over the table
        Ball(1.3, 0.0, 1.3, -3.5, 0.0, 1.0),  # bounces before the net
        Ball(1.3, 0.5, 1.1, -5.0, 2.0, 1.3),  # beside the table
    ],
)
def test_an_unfair_launch_is_no_ball(launch: Ball) -> None:
    assert snapshot_of(launch) is None


def test_the_same_seed_draws_the_same_ball() -> None:
    first, second = (LAUNCHERS["wide"].draw(np.random.default_rng(11)) for _ in range(2))
    assert first.tobytes() == second.tobytes()
