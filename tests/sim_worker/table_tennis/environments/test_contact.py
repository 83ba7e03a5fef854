"""The contact simulation against theory, and how far it departs where it does."""

import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from crkr.sim_worker.simulation.simulation import (
    BALL_POSITION,
    BALL_ROTATION,
    BALL_SPIN,
    BALL_VELOCITY,
    BallAlone,
    Diverged,
    Simulation,
    rotated,
)
from crkr.sim_worker.table_tennis.ball.constants import (
    BALL_RADIUS,
    MAGNUS,
    PADDLE_FRICTION,
    PADDLE_RESTITUTION,
    TABLE_FRICTION,
    TABLE_HEIGHT,
    TABLE_RESTITUTION,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, flight
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.scene import ArmAlone, load_scene, make_ball_alone, make_simulation

UP = np.array([0.0, 0.0, 1.0])
PHASES = np.linspace(0.0, 1.0, 20, endpoint=False)  # of a time step at which the contact begins


@pytest.fixture(scope="module")
def alone() -> BallAlone:
    return make_ball_alone()


def _after_bounce(
    alone: BallAlone, velocity: tuple[float, float, float], phase: float
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and spin just after a bounce that begins `phase` of a step after a step."""
    height = TABLE_HEIGHT + BALL_RADIUS - velocity[2] * alone.timestep * (20 + phase)
    path = alone.path(np.array([-0.7, 0.0, height, *velocity]), 0.05)
    inside = np.flatnonzero(path[:, 2] < TABLE_HEIGHT + BALL_RADIUS)
    row = path[inside[-1] + 1]
    return row[3:6], row[6:]


def test_a_drop_from_30_cm_returns_to_between_23_and_26_cm(alone: BallAlone) -> None:
    """The laws' own test of a table, at every phase of the time step."""
    fall = np.sqrt(2 * 0.3 / 9.81)
    for phase in PHASES:
        height = TABLE_HEIGHT + BALL_RADIUS + 0.3 + phase * np.sqrt(2 * 9.81 * 0.3) * alone.timestep
        path = alone.path(np.array([-0.7, 0.0, height, 0.0, 0.0, 0.0]), 3 * fall)
        bottom = int(np.argmin(path[: int(1.5 * fall / alone.timestep), 2]))
        assert 0.23 <= path[bottom:, 2].max() - TABLE_HEIGHT - BALL_RADIUS <= 0.26


@pytest.mark.parametrize("velocity", [(-4.2, 0.0, -3.0), (-6.0, 0.0, -2.5), (-4.5, 0.3, -3.5)])
def test_an_oblique_bounce_departs_from_the_rigid_one_by_a_few_percent(
    alone: BallAlone, velocity: tuple[float, float, float]
) -> None:
    """Soft friction also pushes: mean restitution within 5 %, tangential speed within 6 %, spin within 15 %.

    Spin is low because the ball sinks in by some millimetres, which shortens friction's lever.
    """
    exact, spin = bounce(
        np.array(velocity), np.zeros(3), UP, np.zeros(3),
        restitution=TABLE_RESTITUTION, friction=TABLE_FRICTION, radius=BALL_RADIUS,
    )  # fmt: skip
    simulated = [_after_bounce(alone, velocity, phase) for phase in PHASES]
    after, spun = (np.mean([pair[k] for pair in simulated], axis=0) for k in range(2))
    assert after[2] == pytest.approx(exact[2], rel=0.05)
    assert after[0] == pytest.approx(exact[0], rel=0.06)
    assert spun[1] == pytest.approx(spin[1], rel=0.15)
    assert np.std([pair[0][2] for pair in simulated]) < 0.03 * exact[2] / TABLE_RESTITUTION


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.6])
def test_the_paddle_returns_the_ball_as_a_rigid_plane_would(simulation: Simulation, tilt: float) -> None:
    """At the paddle's centre, arm held still: restitution within 4 % on average, friction's impulse 15 %, spin 20 %."""
    model = simulation.model
    data = mujoco.MjData(model)
    data.qpos[:6] = HOME
    mujoco.mj_kinematics(model, data)
    site = model.site("paddle").id
    centre, frame = data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3)
    normal, along = frame[:, 0], frame[:, 2]
    velocity = 5.0 * (-np.cos(tilt) * normal + np.sin(tilt) * along)
    gains = np.tile(_hold(simulation), (40, 1))
    after, spins = [], []
    for phase in PHASES:
        start = centre + (0.006 + BALL_RADIUS) * normal - velocity * simulation.timestep * (8 + phase)
        last = simulation.run(simulation.start(HOME, np.concatenate([start, velocity])), gains).states[-1:]
        after.append(last[0, BALL_VELOCITY] + [0, 0, 9.81 * 0.04])
        spins.append(rotated(last[:, BALL_ROTATION], last[:, BALL_SPIN])[0])
    exact, spin = bounce(
        velocity, np.zeros(3), normal, np.zeros(3),
        restitution=PADDLE_RESTITUTION, friction=PADDLE_FRICTION, radius=BALL_RADIUS,
    )  # fmt: skip
    mean, spun = np.mean(after, axis=0), np.mean(spins, axis=0)
    assert mean @ normal == pytest.approx(exact @ normal, rel=0.04)
    assert (mean - velocity) @ along == pytest.approx((exact - velocity) @ along, rel=0.15, abs=0.05)
    # Gravity on the way gives a square ball some spin.
    assert np.linalg.norm(spun - spin) < max(0.2 * float(np.linalg.norm(spin)), 5.0)


def test_drag_in_the_simulation_is_the_drag_of_the_flight_formula(alone: BallAlone) -> None:
    start = Ball(0.5, 0.1, 1.5, -4.4, 0.2, 1.0)
    path = alone.path(np.array(start), 0.2)
    expected = np.array(flight(start, (len(path) - 1) * alone.timestep))
    # The simulator's first-order steps are off by half a step of gravity: g t dt / 2.
    assert np.abs(path[-1, :6] - expected).max() < 1.5e-3


SPIN = np.array([40.0, -150.0, 60.0])


def test_spin_does_not_bend_a_flight_unless_it_is_to(alone: BallAlone) -> None:
    start = Ball(0.5, 0.1, 1.5, -4.4, 0.2, 1.0)
    path = alone.path(np.array(start), 0.3, SPIN)
    expected = np.array(flight(start, 0.3))
    assert np.abs(path[-1, :6] - expected).max() < 2e-3
    assert path[-1, 6:] == pytest.approx(SPIN)


def test_lift_is_that_of_its_coefficient() -> None:
    """Half density, area, coefficient r omega / v and v^2 make the force, across spin and velocity; in one step."""
    start = np.array([0.5, 0.1, 1.5, -4.4, 0.2, 1.0])
    lifted, straight = (make_ball_alone(magnus=magnus).path(start, 0.002, SPIN)[1, 3:6] for magnus in (True, False))
    across = np.cross(SPIN, start[3:])
    area, mass = np.pi * BALL_RADIUS**2, 0.0027
    assert (lifted - straight) / 0.001 == pytest.approx(0.5 * 1.2 * area * BALL_RADIUS * across / mass, abs=0.02)


def test_a_lifted_flight_is_that_of_the_formula() -> None:
    start = Ball(0.5, 0.1, 1.5, -4.4, 0.2, 1.0)
    path = make_ball_alone(magnus=True).path(np.array(start), 0.3, SPIN)
    curl = MAGNUS * SPIN
    expected = np.array(flight(start, 0.3, (float(curl[0]), float(curl[1]), float(curl[2]))))
    assert np.abs(path[-1, :6] - expected).max() < 2.5e-3
    assert np.abs(expected - np.array(flight(start, 0.3)))[:3].max() > 0.1


def test_the_ball_alone_and_the_ball_in_the_scene_are_the_same(simulation: Simulation, alone: BallAlone) -> None:
    ball = np.array([0.5, 0.1, 1.2, -4.4, 0.1, -0.4])
    record = simulation.run(simulation.start(HOME, ball), np.tile(_hold(simulation), (400, 1)))
    path = alone.path(ball, 0.4)
    assert np.abs(record.states[:, BALL_POSITION] - path[:401, :3]).max() < 1e-6


def test_runs_repeat_bitwise_whatever_ran_before(simulation: Simulation) -> None:
    start = simulation.start(HOME, np.array([0.5, 0.1, 1.2, -4.4, 0.1, -0.4]))
    controls = np.tile(_hold(simulation), (600, 1))
    first = simulation.run(start, controls).states.tobytes()
    simulation.run(simulation.start(HOME + 0.1, np.array([0.4, 0.0, 1.0, -4.0, 0.3, 0.0])), controls * 0.5)
    assert simulation.run(start, controls).states.tobytes() == first
    assert make_simulation().run(start, controls).states.tobytes() == first


def test_a_breakdown_is_reported_and_leaves_no_trace(simulation: Simulation) -> None:
    start = simulation.start(HOME, np.array([0.5, 0.1, 1.2, -4.4, 0.1, -0.4]))
    controls = np.tile(_hold(simulation), (50, 1))
    before = simulation.run(start, controls).states.tobytes()
    broken = controls.copy()
    broken[20] = np.nan
    with pytest.raises(Diverged, match="broke down"):
        simulation.run(start, broken)
    flung = start.copy()
    flung[BALL_VELOCITY] = 1e12
    with pytest.raises(Diverged, match="broke down"):
        simulation.run(flung, controls)
    assert simulation.run(start, controls).states.tobytes() == before


@pytest.mark.parametrize("torque", [np.nan, np.inf, 1e300])
def test_a_breakdown_of_the_arm_alone_is_reported_and_leaves_no_trace(simulation: Simulation, torque: float) -> None:
    alone = ArmAlone()
    controls = np.tile(_hold(simulation), (50, 1))
    before = alone.run(HOME, controls)
    broken = controls.copy()
    broken[20, 2] = torque
    with pytest.raises(Diverged, match="broke down"):
        alone.run(HOME, broken)
    with pytest.raises(Diverged, match="broke down"):
        alone.run(np.full(6, 1e12), controls)
    again = alone.run(HOME, controls)
    assert all(one.tobytes() == other.tobytes() for one, other in zip(before, again, strict=True))


def test_a_breakdown_writes_no_file(tmp_path: Path) -> None:
    """In a process of its own: MuJoCo opens its log where the process works."""
    program = (
        "import numpy as np\n"
        "from crkr.sim_worker.table_tennis.planner import HOME\n"
        "from crkr.sim_worker.simulation.simulation import Diverged\n"
        "from crkr.sim_worker.table_tennis.scene import make_simulation\n"
        "simulation = make_simulation()\n"
        "start = simulation.start(HOME, np.array([0.5, 0.1, 1.2, 1e12, 0.0, 0.0]))\n"
        "try:\n"
        "    simulation.run(start, np.zeros((20, 6)))\n"
        "except Diverged:\n"
        "    raise SystemExit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 7, done.stderr
    assert list(tmp_path.iterdir()) == []
    assert done.stdout + done.stderr == b""


def test_poses_are_mujocos(simulation: Simulation) -> None:
    rng = np.random.default_rng(0)
    joints, balls = rng.uniform(-1, 1, (3, 6)), rng.uniform(-1, 1, (3, 3))
    positions, quaternions = simulation.poses(joints, balls)
    data = mujoco.MjData(simulation.model)
    data.qpos[:6], data.qpos[6:9] = joints[1], balls[1]
    mujoco.mj_kinematics(simulation.model, data)
    for index, name in enumerate(simulation.bodies):
        assert positions[1, index] == pytest.approx(data.body(name).xpos)
        assert np.roll(quaternions[1, index], 1) == pytest.approx(data.body(name).xquat)


def test_shapes_stand_where_mujoco_has_them(simulation: Simulation) -> None:
    """Each shape's world position, recomputed from its body's pose as a viewer would."""
    data = mujoco.MjData(simulation.model)
    data.qpos[:6] = HOME
    mujoco.mj_kinematics(simulation.model, data)
    geoms = simulation.geoms()
    assert len(geoms) == simulation.model.ngeom
    for index, geom in enumerate(geoms):
        body = data.body(geom.body)
        there = body.xpos + body.xmat.reshape(3, 3) @ np.array(geom.position)
        sunk = 0.005 if simulation.model.geom(index).name == "floor" else 0.0
        assert there == pytest.approx(data.geom_xpos[index] - [0, 0, sunk], abs=1e-9)
        assert np.linalg.norm(geom.quaternion) == pytest.approx(1.0)
    assert {geom.body for geom in geoms} == {"world", *simulation.bodies}


def test_only_the_ball_touches_anything() -> None:
    model = load_scene().compile()
    assert not model.geom_contype.any()
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    touching = [{model.geom(int(index)).name for index in pair} for pair in pairs]
    assert all("ball" in pair for pair in touching)
    assert set().union(*touching) == {"ball", "table", "net", "paddle"}


def _hold(simulation: Simulation) -> np.ndarray:
    """Controls that hold the arm at home against gravity."""
    data = mujoco.MjData(simulation.model)
    data.qpos[:6] = HOME
    mujoco.mj_forward(simulation.model, data)
    return np.asarray(simulation.gains.stiffness * HOME + data.qfrc_bias[:6])
