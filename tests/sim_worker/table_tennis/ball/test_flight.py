"""Flight and impact against closed solutions and a second integrator."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from crkr.sim_worker.table_tennis.ball.constants import DRAG, GRAVITY, SPIN_INERTIA
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, flight, fly, fly_to_height, fly_to_x

UP = np.array([0.0, 0.0, 1.0])
RADIUS = 0.02
speeds = st.floats(-6, 6)
vectors = st.tuples(speeds, speeds, speeds)


def _derivative(_: float, state: np.ndarray) -> np.ndarray:
    velocity = state[3:]
    return np.concatenate([velocity, -DRAG * np.linalg.norm(velocity) * velocity - [0, 0, GRAVITY]])


def test_flight_agrees_with_an_adaptive_integrator() -> None:
    start = np.array([1.3, 0.1, 1.1, -5.0, 0.2, 1.4])
    exact = solve_ivp(_derivative, (0, 0.8), start, rtol=1e-11, atol=1e-12).y[:, -1]
    assert np.abs(np.array(flight(Ball(*start), 0.8)) - exact).max() < 1e-7


def test_a_lifted_flight_agrees_with_an_adaptive_integrator() -> None:
    curl = np.array([0.2, -0.8, 0.3])
    start = np.array([1.3, 0.1, 1.1, -5.0, 0.2, 1.4])

    def derivative(time: float, state: np.ndarray) -> np.ndarray:
        return np.asarray(_derivative(time, state) + np.concatenate([np.zeros(3), np.cross(curl, state[3:])]))

    exact = solve_ivp(derivative, (0, 0.8), start, rtol=1e-11, atol=1e-12).y[:, -1]
    assert np.abs(np.array(flight(Ball(*start), 0.8, (0.2, -0.8, 0.3))) - exact).max() < 1e-7


def test_a_falling_ball_approaches_the_speed_at_which_drag_carries_it() -> None:
    ball = flight(Ball(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 6.0)
    assert -ball.vz == pytest.approx(np.sqrt(GRAVITY / DRAG), rel=1e-3)


def test_flying_back_undoes_flying() -> None:
    start = Ball(0.5, 0.1, 1.2, -4.4, 0.2, -0.4)
    assert flight(flight(start, 0.3), -0.3) == pytest.approx(start, abs=1e-8)


def test_many_balls_fly_as_each_would_alone() -> None:
    balls = np.random.default_rng(0).normal(size=(6, 50))
    together = np.array(fly(Ball(*balls), 0.02))
    alone = np.array([fly(Ball(*ball.tolist()), 0.02) for ball in balls.T]).T
    assert np.abs(together - alone).max() < 1e-15


@given(st.tuples(st.floats(-5, -2), st.floats(-1, 1), st.floats(-1, 2)))
def test_crossings_are_on_the_flight_and_on_the_plane(velocity: tuple[float, float, float]) -> None:
    start = Ball(0.5, 0.0, 1.2, *velocity)
    landing = fly_to_height(start, 0.78)
    assert landing is not None
    assert landing[1].z == pytest.approx(0.78, abs=1e-9)
    assert landing[1].vz < 0
    assert flight(start, landing[0]) == pytest.approx(landing[1], abs=1e-7)
    crossing = fly_to_x(start, 0.3)
    assert crossing is not None
    assert crossing[1].x == pytest.approx(0.3, abs=1e-9)


def test_a_ball_below_never_comes_down_to_a_height_above_it() -> None:
    assert fly_to_height(Ball(0.0, 0.0, 0.5, 1.0, 0.0, 0.0), 0.78) is None
    assert fly_to_x(Ball(0.0, 0.0, 0.5, 1.0, 0.0, 0.0), 5.0) is None


def test_without_slip_only_the_normal_speed_turns_round() -> None:
    velocity, spin = bounce(
        np.array([0.0, 0.0, -3.0]), np.zeros(3), UP, np.zeros(3), restitution=0.9, friction=0.2, radius=RADIUS
    )
    assert velocity == pytest.approx([0, 0, 2.7])
    assert spin == pytest.approx([0, 0, 0])


@given(vectors, st.tuples(*[st.floats(-200, 200)] * 3), vectors, st.floats(0, 1), st.floats(0, 2))
def test_an_impact_obeys_coulomb_restitution_and_angular_momentum(
    velocity: tuple[float, ...],
    spin: tuple[float, ...],
    surface: tuple[float, ...],
    restitution: float,
    friction: float,
) -> None:
    v, w, u = np.array(velocity), np.array(spin), np.array(surface)
    after, spun = bounce(v, w, UP, u, restitution=restitution, friction=friction, radius=RADIUS)
    approach = u[2] - v[2]
    if approach <= 0:
        assert after.tolist() == v.tolist()
        assert spun.tolist() == w.tolist()
        return
    assert after[2] - u[2] == pytest.approx(restitution * approach, abs=1e-9)
    pull = after - v
    assert np.linalg.norm(pull[:2]) <= friction * (1 + restitution) * approach + 1e-9
    # About the contact point the impulse has no moment: L = I w + r x m v is conserved there.
    arm = RADIUS * UP
    inertia = SPIN_INERTIA * RADIUS**2
    assert inertia * (spun - w) + np.cross(arm, pull) == pytest.approx(np.zeros(3), abs=1e-9)
    # Friction never reverses the slip at the contact.
    slip = (v - u + np.cross(w, -arm))[:2]
    left = (after - u + np.cross(spun, -arm))[:2]
    assert slip @ left >= -1e-6 * (1 + slip @ slip)
    assert np.linalg.norm(left) <= np.linalg.norm(slip) + 1e-9


def test_many_impacts_are_as_each_alone() -> None:
    rng = np.random.default_rng(2)
    velocity, spin, surface, normal = rng.normal(size=(4, 40, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    settings = {"restitution": 0.8, "friction": 0.4, "radius": RADIUS}
    after, spun = bounce(velocity, spin * 50, normal, surface, **settings)
    for row in range(40):
        one, turned = bounce(velocity[row], spin[row] * 50, normal[row], surface[row], **settings)
        assert one == pytest.approx(after[row])
        assert turned == pytest.approx(spun[row])
