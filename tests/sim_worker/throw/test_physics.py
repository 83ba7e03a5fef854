"""The throw against an adaptive integrator, the scene against its numbers, contact against formulas."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.simulation.flight import Ball
from crkr.sim_worker.simulation.simulation import load_spec
from crkr.sim_worker.throw import Throw
from crkr.sim_worker.throw.environments import make_arm
from crkr.sim_worker.throw.layouts import (
    BALL_MASS,
    BALL_RADIUS,
    OPENING,
    RIM,
    WALL_HALF_THICKNESS,
    WALL_HALF_WIDTH,
    Layout,
)
from crkr.sim_worker.throw.outcome import Passage, reason_of
from crkr.sim_worker.throw.planner import HOME, full_goal

LAYOUT = Layout(2.3, 0.1, 1.8, 0.9)
DRAG = 0.5 * 1.2 * 0.47 * np.pi * 0.0335**2 / 0.058  # [1/m]


@pytest.fixture(scope="module")
def arm() -> Arm:
    return make_arm()


def _integrated(ball: Ball, event: float, axis: int) -> np.ndarray:
    """The ball (6,) when coordinate `axis` passes `event`, falling, by an adaptive integrator."""

    def slope(_: float, state: np.ndarray) -> np.ndarray:
        velocity = state[3:]
        return np.concatenate([velocity, [0, 0, -9.81] - DRAG * np.linalg.norm(velocity) * velocity])

    def passes(_: float, state: np.ndarray) -> float:
        return float(state[axis] - event)

    passes.direction = -1 if axis == 2 else 0  # type: ignore[attr-defined]  # as SciPy reads it
    passes.terminal = True  # type: ignore[attr-defined]  # as SciPy reads it
    found = solve_ivp(slope, (0.0, 5.0), np.array(ball), events=passes, rtol=1e-11, atol=1e-11)
    return np.asarray(found.y_events[0][0])


def test_a_passage_is_that_of_an_adaptive_integrator() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        ball = Ball(*rng.uniform([-0.8, 0.0, 1.5, 2.5, -0.5, 1.0], [-0.3, 0.3, 2.0, 4.0, 0.5, 3.5]).tolist())
        passage = Passage.of(ball, LAYOUT)
        landing = _integrated(ball, RIM, 2)
        assert passage.miss == pytest.approx(landing[:2] - [2.3, 0.1], abs=1e-6)
        over = min(_integrated(ball, face, 0)[2] for face in (1.78, 1.82)) - 0.0335 - 0.9
        assert passage.clearance == pytest.approx(over, abs=1e-6)


def test_what_is_not_reached_is_not_observed() -> None:
    backwards = Passage.of(Ball(-0.5, 0.0, 1.9, -2.0, 0.0, 1.0), LAYOUT)
    assert np.isnan(backwards.clearance)
    assert backwards.miss[0] < -2
    low = Passage.of(Ball(-0.5, 0.0, 0.2, 1.0, 0.0, 0.5), LAYOUT)
    assert np.isnan(low.miss).all()
    assert low.landing_time is None
    assert low.clearance < -1  # it falls short, and tells by how much
    assert (backwards.cost, low.cost) == (1.0, 1.0)
    assert [reason_of(one, False) for one in (backwards, low)] == ["wall", "wall"]


@pytest.mark.parametrize(
    ("miss", "clearance", "inside", "reason"),
    [
        ((0.0, 0.0), 0.1, True, "in"),
        ((0.0, 0.0), -0.1, False, "wall"),
        ((0.145, 0.0), 0.1, False, "rim"),
        ((-0.3, 0.1), 0.1, False, "short"),
        ((0.3, 0.1), 0.1, False, "long"),
        ((0.1, -0.3), 0.1, False, "beside"),
    ],
)
def test_reasons_say_where_the_ball_went(
    miss: tuple[float, float], clearance: float, inside: bool, reason: str
) -> None:
    passage = Passage(np.array(miss), clearance, 1.0)
    assert passage.is_clear == inside
    assert reason_of(passage, inside) == reason


def test_costs_grow_with_the_miss_and_with_what_lacks_over_the_wall() -> None:
    costs = [Passage(np.array([miss, 0.0]), over, 1.0).cost for miss, over in [(0, 0.1), (0.1, 0.1), (0.1, -0.1)]]
    assert costs[0] == 0.0
    assert costs[1] == pytest.approx(1 - np.exp(-0.5))
    assert costs[2] == pytest.approx(1 - np.exp(-1.0))


def test_the_scene_has_the_numbers_of_the_formulas() -> None:
    model = load_spec("throw").compile()
    ball, wall, near = (model.geom(name) for name in ("ball", "wall", "bin_near"))
    assert ball.size[0] == BALL_RADIUS
    assert model.body("ball").mass[0] == BALL_MASS
    assert (wall.size[0], wall.size[1]) == (WALL_HALF_THICKNESS, WALL_HALF_WIDTH)
    assert wall.pos[2] + wall.size[2] == 0.0  # its body's origin is the top edge
    assert -near.pos[0] - near.size[0] == pytest.approx(OPENING)
    assert near.pos[2] + near.size[2] == 0.0
    assert model.body("bin").pos[2] == RIM
    bottom = model.geom("bin_bottom")
    assert RIM + bottom.pos[2] - bottom.size[2] == pytest.approx(0.0)


def test_the_grip_is_the_tool_of_the_arm(arm: Arm) -> None:
    model = load_spec("throw").compile()
    data, site, rng = mujoco.MjData(model), model.site("grip").id, np.random.default_rng(0)
    for _ in range(50):
        joints = rng.uniform(-3, 3, 6)
        data.qpos[:6] = joints
        mujoco.mj_kinematics(model, data)
        assert np.abs(arm.tool(joints).position - data.site_xpos[site]).max() < 1e-9


def test_the_wall_is_out_of_the_arms_reach(arm: Arm) -> None:
    """The farthest point of the stretched arm is nearer than the nearest wall."""
    rng = np.random.default_rng(1)
    farthest = max(np.linalg.norm(arm.tool(rng.uniform(-np.pi, np.pi, 6)).position[:2]) for _ in range(3000))
    assert farthest + 2 * BALL_RADIUS < 1.6 - WALL_HALF_THICKNESS


def test_contact_and_analytic_agree(contact: Throw, analytic: Throw) -> None:
    """Where the ball passes within a centimetre; whether it is in, but for balls that touch the rim."""
    rng, apart, same = np.random.default_rng(3), [], []
    scales = np.array([axis.scale for axis in contact.spec().goal])
    low, high = contact.spec().bounds
    for _ in range(40):
        state = contact.reset(rng)
        plan = analytic.plan(state)
        assert plan is not None
        goal = np.clip(plan[0] + 0.15 * scales * rng.normal(size=8), low, high)
        one, other = contact.attempt(state, goal), analytic.attempt(state, goal)
        assert one.executed == other.executed
        if one.executed and one.outcome is not None and other.outcome is not None:
            apart.append(np.abs(one.outcome - other.outcome)[:3])
            near_rim = abs(np.abs(other.outcome[:2]).max() - OPENING) < BALL_RADIUS or abs(other.outcome[2]) < 0.01
            same.extend([] if near_rim else [one.success == other.success])
    assert len(same) > 20
    assert all(same)
    assert np.median(apart, axis=0).max() < 0.01
    assert np.max(apart) < 0.05


def test_the_ball_leaves_with_the_hands_velocity(contact: Throw, arm: Arm) -> None:
    """In contact, followed back from where the film has it shortly after the release."""
    plan = contact.plan(contact.reset(np.random.default_rng(8)))
    assert plan is not None
    film = contact.film(plan[0], 0.001)
    assert film is not None
    position, speed, time = full_goal(plan[0])
    ideal = arm.tool(position, speed)
    path, times = film.trace.paths["ball"], film.trace.time
    rows = np.flatnonzero((times > time + 0.005) & (times < time + 0.05))
    since = times[rows, None] - time
    flown = ideal.position + since * ideal.velocity - [0, 0, 0.5 * 9.81] * since**2
    assert np.abs(path[rows] - flown).max() < 3e-3
    assert path[0] == pytest.approx(arm.tool(HOME).position, abs=1e-3)
