"""The arm in Pinocchio is the arm in MuJoCo."""

import mujoco
import numpy as np
import pytest

from crkr.sim_worker.arm.dynamics import SPEED_LIMITS, Arm, Unreachable
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.planner import HOME, POSTURE

NORMAL = np.array([np.cos(0.15), 0.0, np.sin(0.15)])


def test_forward_kinematics_equals_mujocos(arm: Arm, simulation: Simulation) -> None:
    model = simulation.model
    data, site, rng = mujoco.MjData(model), model.site("paddle").id, np.random.default_rng(0)
    for _ in range(200):
        joints = rng.uniform(-3, 3, 6)
        data.qpos[:6] = joints
        mujoco.mj_kinematics(model, data)
        paddle = arm.tool(joints)
        assert np.abs(paddle.position - data.site_xpos[site]).max() < 1e-9
        assert np.abs(paddle.normal - data.site_xmat[site].reshape(3, 3)[:, 0]).max() < 1e-9


def test_the_drawn_paddle_is_a_disc_across_the_normal(arm: Arm, simulation: Simulation) -> None:
    model = simulation.model
    data = mujoco.MjData(model)
    data.qpos[:6] = HOME
    mujoco.mj_kinematics(model, data)
    paddle = arm.tool(HOME)
    geom = model.geom("paddle").id
    assert data.geom_xpos[geom] == pytest.approx(paddle.position)
    assert abs(data.geom_xmat[geom].reshape(3, 3)[:, 2] @ paddle.normal) == pytest.approx(1.0)


def test_inverse_dynamics_equals_mujocos_but_for_the_air(arm: Arm, simulation: Simulation) -> None:
    model = simulation.model
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    still = model.opt.density
    model.opt.density = 0.0
    try:
        for _ in range(50):
            joints, speeds, accelerations = rng.uniform(-2, 2, (3, 6))
            data.qpos[:6], data.qvel[:6] = joints, speeds
            data.qacc[:] = 0.0
            data.qacc[:6] = accelerations
            mujoco.mj_inverse(model, data)
            assert np.abs(arm.torques(joints, speeds, accelerations) - data.qfrc_inverse[:6]).max() < 1e-9
    finally:
        model.opt.density = still


def test_the_jacobian_is_the_derivative_of_the_paddles_position(arm: Arm) -> None:
    jacobian, step = arm.jacobian(HOME)[:3], 1e-6
    for joint, offset in enumerate(np.eye(6) * step):
        slope = (arm.tool(HOME + offset).position - arm.tool(HOME - offset).position) / (2 * step)
        assert jacobian[:, joint] == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize("y", [-0.4, 0.0, 0.4])
@pytest.mark.parametrize("z", [0.9, 1.05, 1.2])
def test_inverse_kinematics_puts_the_face_where_it_is_wanted(arm: Arm, y: float, z: float) -> None:
    target = np.array([-1.47, y, z])
    paddle = arm.tool(arm.reach(target, NORMAL, POSTURE))
    assert paddle.position == pytest.approx(target, abs=1e-9)
    assert paddle.normal == pytest.approx(NORMAL, abs=1e-9)


def test_nearby_targets_have_nearby_joints(arm: Arm) -> None:
    path = [arm.reach(np.array([-1.47, y, 1.0]), NORMAL, POSTURE) for y in np.linspace(-0.3, 0.3, 61)]
    assert np.abs(np.diff(path, axis=0)).max() < 0.06


def test_what_is_too_far_away_is_unreachable(arm: Arm) -> None:
    with pytest.raises(Unreachable):
        arm.reach(np.array([1.0, 0.0, 1.0]), NORMAL, POSTURE)


def test_joint_speeds_give_the_paddle_the_wanted_velocity(arm: Arm) -> None:
    wanted = np.array([1.2, -0.1, 0.3])
    speeds = arm.speeds_for(POSTURE, wanted)
    assert arm.tool(POSTURE, speeds).velocity == pytest.approx(wanted, abs=1e-9)
    other = speeds + SPEED_LIMITS * 0.1 * np.linalg.svd(arm.jacobian(POSTURE)[:3] * SPEED_LIMITS)[2][-1]
    assert arm.tool(POSTURE, other).velocity == pytest.approx(wanted, abs=1e-9)
    assert np.linalg.norm(other / SPEED_LIMITS) > np.linalg.norm(speeds / SPEED_LIMITS)
