import mujoco
import numpy as np
import pytest

from crkr.sim_worker.arm.collision import MARGIN, CollisionCheck
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.table_tennis.ball.constants import PADDLE_HALF_THICKNESS, PADDLE_RADIUS, TABLE_HEIGHT
from crkr.sim_worker.table_tennis.planner import HOME, POSTURE
from crkr.sim_worker.table_tennis.scene import make_check

NORMAL = np.array([1.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def check(arm: Arm) -> CollisionCheck:
    return make_check(arm)


def _collides(check: CollisionCheck, joints: np.ndarray) -> bool:
    return check.clearance(joints[None])[0] < MARGIN or check.first(joints[None]) is not None


def test_the_arm_at_home_touches_nothing(check: CollisionCheck) -> None:
    assert _collides(check, HOME) is False


@pytest.mark.parametrize(("gap", "collides"), [(0.005, True), (0.015, False), (-0.02, True)])
def test_the_paddle_keeps_one_centimetre_from_the_table(
    check: CollisionCheck, arm: Arm, gap: float, collides: bool
) -> None:
    """An upright blade over the table: its lowest point is a radius below its centre."""
    joints = arm.reach(np.array([-1.3, 0.0, TABLE_HEIGHT + PADDLE_RADIUS + gap]), NORMAL, POSTURE)
    assert check.clearance(joints[None])[0] == pytest.approx(gap, abs=1e-3) or gap < 0
    assert _collides(check, joints) == collides


def test_beside_the_table_the_paddle_may_be_low(check: CollisionCheck, arm: Arm) -> None:
    far = arm.reach(np.array([-1.37 - PADDLE_HALF_THICKNESS - 0.015, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert not _collides(check, far)
    near = arm.reach(np.array([-1.37 - PADDLE_HALF_THICKNESS - 0.005, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert _collides(check, near)


def test_the_net_is_out_of_reach(arm: Arm) -> None:
    """No point of a shape is farther from the shoulder's axis than all the links on the way, one behind the other."""
    links = [float(np.linalg.norm(placement.translation)) for placement in arm.model.jointPlacements]
    farthest = 0.0
    for shape in arm.shapes.geometryObjects:
        if shape.parentJoint:
            shape.geometry.computeLocalAABB()
            centre = shape.placement.act(shape.geometry.aabb_center)
            own = float(np.linalg.norm(centre)) + shape.geometry.aabb_radius
            farthest = max(farthest, own + sum(links[2 : shape.parentJoint + 1]))
    assert farthest > 1.5
    net = next(shape for shape in arm.shapes.geometryObjects if shape.name == "net")
    net.geometry.computeLocalAABB()
    face = net.placement.translation[0] - net.geometry.halfSide[0]
    assert arm.model.jointPlacements[1].translation[0] + farthest < face - 0.05


def test_the_first_of_the_samples_nearest_to_the_table_is_named(check: CollisionCheck, arm: Arm) -> None:
    low = arm.reach(np.array([-1.3, 0.0, TABLE_HEIGHT]), NORMAL, POSTURE)
    assert check.clearance(np.array([HOME, POSTURE, low, HOME, low]))[1] == 2


CHAIN = ("base", "shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")


def _nearest(simulation: Simulation, data: mujoco.MjData) -> float:
    """MuJoCo's smallest distance [m] between shapes of links that are no neighbours, and to pedestal, table and net."""
    model = simulation.model
    links = {index: CHAIN.index(model.body(int(body)).name) for index, body in _arms(simulation)}
    still = [model.geom(name).id for name in ("table", "net")]
    gaps = [1.0]
    for one, place in links.items():
        others = [other for other, there in links.items() if there >= place + 2]
        if place >= 3:  # upper arm and shoulder are not checked against the table
            others += still
        gaps += [mujoco.mj_geomDistance(model, data, one, other, 1.0, None) for other in others]
    return min(gaps)


def _arms(simulation: Simulation) -> list[tuple[int, int]]:
    """Shapes of the arm with their bodies; the pedestal, which stands in the world, belongs to the base."""
    model, base = simulation.model, simulation.model.body("base").id
    shapes = [(index, int(model.geom_bodyid[index])) for index in range(model.ngeom)]
    arm = [(index, body) for index, body in shapes if model.body(body).name in CHAIN]
    return [*arm, (int(model.geom("pedestal").id), int(base))]


def test_a_cautious_check_finds_what_mujoco_finds_too_near(arm: Arm, simulation: Simulation) -> None:
    check, model = make_check(arm, itself=True), simulation.model
    data, rng, verdicts = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(300):
        joints = rng.uniform(-np.pi, np.pi, 6)
        data.qpos[:6] = joints
        mujoco.mj_kinematics(model, data)
        nearest = _nearest(simulation, data)
        if abs(nearest - 0.01) > 1e-3:  # the two libraries' distances differ by some tenths of a millimetre
            verdicts.append(nearest < 0.01)
            assert _collides(check, joints) == verdicts[-1]
    assert 0.2 < np.mean(verdicts) < 0.8


def test_only_a_cautious_check_sees_the_hand_fold_into_the_arm(arm: Arm, check: CollisionCheck) -> None:
    folded = HOME + np.array([0.0, -1.2, 1.3, 1.5, 0.0, 0.0])
    cautious = make_check(arm, itself=True)
    way = HOME + np.linspace(0, 1, 91)[:, None] * (folded - HOME)
    assert check.first(way) is None
    row = cautious.first(way)
    assert row is not None
    assert row > 0
    assert row % 2 == 0
