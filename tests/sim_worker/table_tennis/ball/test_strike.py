import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import ToolPose
from crkr.sim_worker.table_tennis.ball.flight import Ball
from crkr.sim_worker.table_tennis.ball.strike import meeting, struck

X = np.array([1.0, 0.0, 0.0])


def _passing(offset: float, *, first: float = 0.2, last: float = -0.2) -> float | None:
    """A ball that flies along x through a still, upright paddle at the origin, `offset` beside its centre."""
    rows = 11
    balls = np.column_stack([np.linspace(first, last, rows), np.full(rows, offset), np.zeros(rows)])
    return meeting(balls, np.zeros((rows, 3)), np.tile(X, (rows, 1)))


def test_they_meet_when_the_surfaces_touch() -> None:
    row = _passing(0.0)
    assert row is not None
    assert 0.2 - 0.04 * row == pytest.approx(0.026)


@pytest.mark.parametrize(("offset", "hits"), [(0.0, True), (0.079, True), (0.081, False), (-0.079, True)])
def test_only_the_blade_counts(offset: float, hits: bool) -> None:
    assert (_passing(offset) is not None) == hits


def test_a_ball_from_behind_is_not_struck() -> None:
    assert _passing(0.0, first=-0.2, last=0.2) is None


def test_a_moving_paddle_meets_a_waiting_ball() -> None:
    balls = np.zeros((11, 3))
    centres = np.column_stack([np.linspace(-0.2, 0.2, 11), np.zeros((11, 2))])
    row = meeting(balls, centres, np.tile(X, (11, 1)))
    assert row is not None
    assert -0.2 + 0.04 * row == pytest.approx(-0.026)


def test_head_on_the_ball_leaves_with_the_restitution_of_the_relative_speed() -> None:
    paddle = ToolPose(np.zeros(3), X, np.array([1.5, 0.0, 0.0]), np.zeros(3))
    after, spin = struck(Ball(0.026, 0.0, 0.0, -3.0, 0.0, 0.0), np.zeros(3), paddle)
    assert after.vx == pytest.approx(1.5 + 0.8 * 4.5)
    assert spin == pytest.approx(np.zeros(3))


def test_a_grazing_impact_spins_the_ball_as_it_slows_it() -> None:
    """The impulse that changes the tangential speed acts a radius away: I spin = r x m change, I = 2/3 m r^2."""
    still = ToolPose(np.zeros(3), X, np.zeros(3), np.zeros(3))
    after, spin = struck(Ball(0.026, 0.0, 0.0, -3.0, 2.0, 0.0), np.zeros(3), still)
    assert after.vy < 2.0
    assert spin == pytest.approx([0.0, 0.0, -1.5 * (after.vy - 2.0) / 0.02])


def test_a_turning_paddle_strikes_with_the_speed_of_the_point_of_contact() -> None:
    turning = ToolPose(np.zeros(3), X, np.zeros(3), np.array([0.0, 0.0, -10.0]))  # its +y side comes forward
    moving = ToolPose(np.zeros(3), X, np.array([0.5, 0.06, 0.0]), np.zeros(3))
    ball = Ball(0.026, 0.05, 0.0, -3.0, 0.0, 0.0)
    turned, _ = struck(ball, np.zeros(3), turning)
    assert turned.vx == pytest.approx(struck(ball, np.zeros(3), moving)[0].vx)
