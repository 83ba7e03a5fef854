"""Lift of the exact, event-driven ball: against a second integrator, and against the ball in contact simulation."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from crkr.sim_worker.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS
from crkr.sim_worker.primitives import JointLimits, Primitive
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.ball.flight import flight
from crkr.sim_worker.table_tennis.ball.incoming import FreeBall, Incoming
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS
from crkr.sim_worker.table_tennis.environments.environments import make_environment
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.scene import make_arm, make_ball_alone, make_simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis
from crkr.sim_worker.table_tennis.tracker import judge

SNAPSHOTS = [
    np.array([0.5, 0.1, 1.2, -4.4, 0.1, -0.4]),
    np.array([0.5, -0.2, 1.1, -5.2, 0.6, -0.1]),
    np.array([0.5, 0.0, 1.15, -4.0, -0.3, 0.5]),
]
# Written out once more, from the ball's mass and radius, air of 1.2 kg/m^3, CD = 0.47 and CL = r omega / v.
MASS, RADIUS, CROSS_SECTION = 0.0027, 0.02, np.pi * 0.02**2
TOUCH = 0.76 + RADIUS


def _accelerations(spin: np.ndarray) -> Callable[[float, np.ndarray], np.ndarray]:
    def derivative(_: float, state: np.ndarray) -> np.ndarray:
        velocity = state[3:]
        speed = np.linalg.norm(velocity)
        drag = -0.5 * 1.2 * 0.47 * CROSS_SECTION * speed * velocity / MASS
        lift = 0.5 * 1.2 * CROSS_SECTION * RADIUS * np.cross(spin, velocity) / MASS
        return np.concatenate([velocity, drag + lift - [0, 0, 9.81]])

    return derivative


def _landing(_: float, state: np.ndarray) -> float:
    return float(state[2] - TOUCH)


_landing.terminal = True  # type: ignore[attr-defined]  # how solve_ivp is told
_landing.direction = -1.0  # type: ignore[attr-defined]  # the same


def _integrated(start: np.ndarray, spin: np.ndarray, duration: float) -> tuple[float, np.ndarray]:
    """Time [s] and state (6,) when the ball comes down to the table, or after `duration`."""
    found = solve_ivp(
        _accelerations(spin), (0.0, duration), start, method="DOP853", rtol=1e-12, atol=1e-12, events=_landing
    )
    return float(found.t[-1]), found.y[:, -1]


def _slid(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and spin after a bounce in which a ball without spin slides to the end: 0.2 of the impulse rubs."""
    slip = np.array([velocity[0], velocity[1], 0.0])
    pushed = 0.2 * 1.93 * -velocity[2] * slip / np.linalg.norm(slip)
    after = np.array([velocity[0] - pushed[0], velocity[1] - pushed[1], -0.93 * velocity[2]])
    return after, 1.5 / RADIUS**2 * np.cross([0, 0, -RADIUS], -pushed)


@pytest.mark.parametrize("snapshot", SNAPSHOTS)
def test_an_incoming_ball_is_that_of_a_second_integrator_through_its_bounce(snapshot: np.ndarray) -> None:
    incoming = Incoming(snapshot, 0.75, magnus=True)
    time, landed = _integrated(snapshot, np.zeros(3), 1.0)
    assert incoming.bounces == pytest.approx([time], abs=1e-8)
    velocity, spin = _slid(landed[3:])
    assert np.linalg.norm(spin) > 50
    for later in (0.02, 0.11, 0.2):
        _, exact = _integrated(np.concatenate([landed[:3], velocity]), spin, later)
        ball, turning = incoming.at(time + later)
        assert np.abs(np.array(ball) - exact).max() < 1e-6
        assert turning == pytest.approx(spin, rel=1e-7)
        assert np.abs(incoming.positions(np.array([time + later]))[0] - exact[:3]).max() < 1e-6


def test_lift_bends_an_exact_ball_as_it_bends_a_simulated_one() -> None:
    """By how much it moves a ball 0.2 s after its bounce; the simulated ball spins some percent less."""
    rng, departures = np.random.default_rng(0), []
    exact, plain = FreeBall(magnus=True), FreeBall()
    simulated, simulated_plain = make_ball_alone(magnus=True), make_ball_alone()
    for _ in range(12):
        ball = LAUNCHERS["wide"].draw(rng)
        row = int(1000 * (Incoming(ball, 1.0).bounces[0] + 0.2))
        bend = (exact.path(ball, 1.0)[row] - plain.path(ball, 1.0)[row])[:3]
        other = (simulated.path(ball, 1.0)[row] - simulated_plain.path(ball, 1.0)[row])[:3]
        assert 0.015 < np.linalg.norm(bend) < 0.05
        assert bend[2] < 0  # top spin pulls down
        departures.append(np.linalg.norm(bend - other) / np.linalg.norm(bend))
    assert np.mean(departures) < 0.25
    assert np.max(departures) < 0.4


def test_a_ball_that_spin_does_not_lift_is_not_moved_by_the_option() -> None:
    for time in (0.0, 0.1, 0.2):  # before the bounce there is no spin
        lifted, straight = (Incoming(SNAPSHOTS[0], 0.9, magnus=magnus).at(time)[0] for magnus in (True, False))
        assert lifted == pytest.approx(straight, abs=1e-12)


@pytest.mark.parametrize("name", ["hybrid", "analytic"])
def test_a_return_lands_where_a_second_integrator_has_it(name: str) -> None:
    skill = TableTennis(SkillOptions(environment=name), traces=False, magnus=True)
    ball = skill.reset(np.random.default_rng(5))
    plan = skill.plan(ball)
    assert plan is not None
    goal, arm = plan[0], make_arm()
    limits = JointLimits(arm.lower, arm.upper, SPEED_LIMITS, ACCELERATION_LIMITS)
    swing = Primitive(limits).trajectory(HOME, goal[:6], goal[6:12], goal[12])
    play = make_environment(name, arm, make_simulation(magnus=True), magnus=True).play(ball, swing, float(goal[12]))
    assert play.curl is not None
    spin = np.array(play.curl) * MASS / (0.5 * 1.2 * CROSS_SECTION * RADIUS)
    assert np.linalg.norm(spin) > 20
    duration, landed = _integrated(np.array(play.after), spin, 2.0)
    landing = judge(play).landing
    assert landing is not None
    assert landing[0] == pytest.approx(duration, abs=1e-7)
    assert np.abs(np.array(landing[1]) - landed).max() < 1e-6
    assert np.abs(np.array(flight(play.after, duration)) - landed)[:3].max() > 0.01  # without lift it lands elsewhere


def test_a_lifted_goal_ends_alike_in_every_environment() -> None:
    """The planner meets the lifted ball where it is; returns differ by what contact departs from the exact impact."""
    skills = {
        name: TableTennis(SkillOptions(environment=name), traces=False, magnus=True)
        for name in ("contact", "hybrid", "analytic")
    }
    rng = np.random.default_rng(8)
    costs: list[float] = []
    apart: list[float] = []
    while len(costs) < 8:
        ball = skills["analytic"].reset(rng)
        plan = skills["analytic"].plan(ball)
        if plan is None:
            continue
        results = {name: skill.attempt(ball, plan[0]) for name, skill in skills.items()}
        vectors = {name: result.outcome for name, result in results.items() if result.outcome is not None}
        costs.append(max(float(np.linalg.norm(vector[:3])) for vector in vectors.values()))
        apart.append(float(np.abs(vectors["hybrid"] - vectors["analytic"]).max()))
        assert results["hybrid"].info["reason"] == "returned"
    assert np.median(costs) < 0.05
    assert np.max(apart) < 0.05
