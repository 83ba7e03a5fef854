"""The numbers that formulas use are those of the scene."""

import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import SPEED_LIMITS, Arm
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.ball import constants
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.spec import task_spec


def test_table_net_ball_and_paddle_have_the_sizes_of_the_scene(simulation: Simulation) -> None:
    model = simulation.model
    table, net, ball, paddle = (model.geom(name) for name in ("table", "net", "ball", "paddle"))
    assert table.size[:2].tolist() == [constants.TABLE_HALF_LENGTH, constants.TABLE_HALF_WIDTH]
    assert table.pos[2] + table.size[2] == pytest.approx(constants.TABLE_HEIGHT)
    assert net.pos[2] + net.size[2] == pytest.approx(constants.NET_TOP)
    assert net.size[1] == constants.NET_HALF_LENGTH
    assert ball.size[0] == constants.BALL_RADIUS
    assert paddle.size[:2] == pytest.approx([constants.PADDLE_RADIUS, constants.PADDLE_HALF_THICKNESS])


def test_the_ball_has_the_mass_inertia_and_drag_of_the_scene(simulation: Simulation) -> None:
    model = simulation.model
    ball = model.body("ball")
    assert ball.mass[0] == constants.BALL_MASS
    assert ball.inertia == pytest.approx(constants.SPIN_INERTIA * constants.BALL_MASS * constants.BALL_RADIUS**2)
    area = np.pi * constants.BALL_RADIUS**2
    drag = model.opt.density * model.geom_fluid[model.geom("ball").id, 1] * area / constants.BALL_MASS
    assert drag == pytest.approx(constants.DRAG)
    assert model.opt.gravity.tolist() == [0.0, 0.0, -constants.GRAVITY]


@pytest.mark.parametrize(
    ("pair", "restitution", "friction"),
    [
        ("ball_table", constants.TABLE_RESTITUTION, constants.TABLE_FRICTION),
        ("ball_paddle", constants.PADDLE_RESTITUTION, constants.PADDLE_FRICTION),
    ],
)
def test_contacts_are_damped_for_the_stated_restitution(
    simulation: Simulation, pair: str, restitution: float, friction: float
) -> None:
    values = simulation.model.pair(pair)
    stiffness, damping = -values.solref
    zeta = damping / (2 * np.sqrt(stiffness))
    # A linear spring and damper leaves this share of the speed after half a period.
    assert np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)) == pytest.approx(restitution, abs=1e-4)
    assert values.friction[0] == friction


def test_a_contact_lasts_several_time_steps(simulation: Simulation) -> None:
    for pair in ("ball_table", "ball_paddle"):
        frequency = np.sqrt(-simulation.model.pair(pair).solref[0])
        assert np.pi / frequency >= 5 * simulation.timestep


def test_the_goal_is_bounded_by_the_arms_position_and_speed_limits(arm: Arm) -> None:
    low, high = task_spec(LAUNCHERS["nominal"], "paper").bounds
    assert low[:6] == pytest.approx(arm.lower)
    assert high[:6] == pytest.approx(arm.upper)
    near_low, near_high = task_spec(LAUNCHERS["nominal"], "tuned").bounds
    assert near_low[:6] == pytest.approx(np.maximum(arm.lower, HOME - 1.2))
    assert near_high[:6] == pytest.approx(np.minimum(arm.upper, HOME + 1.2))
    assert near_low[6:] == pytest.approx(low[6:])
    assert near_high[6:] == pytest.approx(high[6:])
    assert high[6:12] == pytest.approx(SPEED_LIMITS)
    assert low[6:12] == pytest.approx(-SPEED_LIMITS)
