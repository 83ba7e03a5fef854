from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, nnls
from swing_goals import HOME, SPEED, WAY, draw_goals, wave

from crkr.protocol import Array
from crkr.protocol.errors import Invalid
from crkr.sim_worker.primitives.stroke import Infeasible, JointLimits, JointTrajectory, Primitive

N, HIT = 45, 25
RANGE = np.array([2 * np.pi, 2 * np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi])
ARM = JointLimits(
    lower=-RANGE,
    upper=RANGE,
    speed=np.deg2rad([120.0, 120.0, 180.0, 180.0, 180.0, 180.0]),
    acceleration=np.array([20.0, 20.0, 25.0, 40.0, 40.0, 60.0]),
)


def one_joint(*, room: float = 10.0, speed: float = 2.0, acceleration: float = 20.0) -> JointLimits:
    return JointLimits(
        lower=np.array([-room]),
        upper=np.array([room]),
        speed=np.array([speed]),
        acceleration=np.array([acceleration]),
    )


def attempt(
    primitive: Primitive, start: Array, position: Array, velocity: Array, hit_time: float
) -> JointTrajectory | Infeasible:
    try:
        return primitive.trajectory(start, position, velocity, hit_time)
    except Infeasible as refusal:
        return refusal


def integrate(acceleration: Array, step: float) -> tuple[Array, Array]:
    """Way and velocity after each interval, one interval after another."""
    way, velocity = [0.0], [0.0]
    for value in acceleration:
        way.append(way[-1] + step * velocity[-1] + 0.5 * step**2 * value)
        velocity.append(velocity[-1] + step * value)
    return np.array(way), np.array(velocity)


def maps(intervals: int, step: float) -> tuple[Array, Array]:
    """Matrices from accelerations to way and velocity at knots 1..N, column by column through `integrate`."""
    columns = [integrate(unit, step) for unit in np.eye(intervals)]
    return np.array([way[1:] for way, _ in columns]).T, np.array([v[1:] for _, v in columns]).T


def cost_matrix(intervals: int, smoothness: float = 20.0) -> Array:
    difference = np.diff(np.eye(intervals), axis=0)
    return np.eye(intervals) + smoothness * difference.T @ difference


def violations(swing: JointTrajectory, limits: JointLimits) -> dict[str, float]:
    """How far a swing leaves its limits, looking between knots too."""
    time = np.unique(np.concatenate([np.linspace(a, b, 33) for a, b in zip(swing.time, swing.time[1:], strict=False)]))
    q, qd, qdd = swing.sample(time)
    return {
        "position": float(np.maximum(q - limits.upper, limits.lower - q).max()),
        "speed": float((np.abs(qd) - limits.speed).max()),
        "acceleration": float((np.abs(qdd) - limits.acceleration).max()),
    }


@pytest.mark.parametrize("amplitude", [0.0, 1.5])
def test_without_binding_limits_the_swing_is_the_solution_of_the_dense_optimality_system(amplitude: float) -> None:
    hit_time = 0.6
    step = hit_time / HIT
    profile = wave(amplitude)
    swing = Primitive(ARM, profile).trajectory(HOME, HOME + WAY, SPEED, hit_time)
    way, velocity = maps(N, step)
    equalities = np.vstack([way[HIT - 1], velocity[HIT - 1], velocity[-1]])
    hessian = cost_matrix(N)
    system = np.block([[hessian, equalities.T], [equalities, np.zeros((3, 3))]])
    demonstrated = profile / hit_time**2
    right = np.vstack([hessian @ demonstrated, WAY, SPEED, np.zeros(6)])
    expected = np.linalg.solve(system, right)[:N]
    assert np.abs(expected).max() < ARM.acceleration.min()
    np.testing.assert_allclose(swing.acceleration, expected, atol=1e-8)


@pytest.mark.parametrize(
    ("way", "goal_velocity", "limits"),
    [
        (0.45, 1.2, one_joint(speed=1.25)),
        (0.40, 1.9, one_joint(acceleration=7.0)),
        (0.28, 1.2, one_joint(room=0.32)),
        (-0.1, 1.4, one_joint(room=0.21, acceleration=17.0)),
    ],
)
def test_with_binding_limits_the_swing_meets_the_conditions_of_optimality(
    way: float, goal_velocity: float, limits: JointLimits
) -> None:
    """Feasibility, stationarity, signs of the multipliers and slackness bound how far the optimum can be."""
    intervals, hit, step = 18, 10, 0.05
    swing = Primitive(limits, intervals=intervals, hit_interval=hit).trajectory(
        np.zeros(1), np.array([way]), np.array([goal_velocity]), hit * step
    )
    found = swing.acceleration[:, 0]
    to_way, to_velocity = maps(intervals, step)
    before = np.vstack([np.zeros(intervals), to_way[:-1]]), np.vstack([np.zeros(intervals), to_velocity[:-1]])
    quantities = np.vstack([np.eye(intervals), to_velocity, to_way, before[0] + 0.5 * step * before[1]])
    bound = np.repeat([limits.acceleration[0], limits.speed[0], limits.upper[0], limits.upper[0]], intervals)
    equalities = np.vstack([to_way[hit - 1], to_velocity[hit - 1], to_velocity[-1]])
    targets = np.array([way, goal_velocity, 0.0])
    hessian = cost_matrix(intervals)

    np.testing.assert_allclose(equalities @ found, targets, atol=1e-8)
    reached = quantities @ found
    assert (np.abs(reached) <= bound * (1 + 1e-8)).all()
    binding = np.abs(reached) >= bound * (1 - 1e-6)
    assert binding.any(), "a limit binds, or the test is void"
    held = np.sign(reached[binding])[:, None] * quantities[binding]

    # Stationarity with multipliers of which those of the limits are not negative, and complementary slackness.
    columns = np.hstack([equalities.T, -equalities.T, -held.T])
    lengths = np.linalg.norm(columns, axis=0)
    multipliers = nnls(columns / lengths, hessian @ found)[0] / lengths
    limited = multipliers[6:]
    residual = float(np.linalg.norm(columns @ multipliers - hessian @ found))
    slack = float(limited @ np.abs(bound - np.abs(reached))[binding])
    # For the way d to the optimum they give d H d <= slack + residual |d|, and the cost curves by the least eigenvalue.
    curvature = float(np.linalg.eigvalsh(hessian)[0])
    distance = (residual + np.sqrt(residual**2 + 4 * curvature * slack)) / (2 * curvature)
    assert distance <= 1e-4
    assert limited.max() > 1e-3, "the limit costs something, or the test is void"


@pytest.mark.parametrize("amplitude", [0.0, 6.0])
def test_shortcuts_give_the_swings_of_clarabel_alone(amplitude: float) -> None:
    both = (Primitive(ARM, wave(amplitude)), Primitive(ARM, wave(amplitude), shortcuts=False))
    swings = [[attempt(one, *goal) for one in both] for goal in draw_goals(ARM, np.random.default_rng(3), 60)]
    found = [[swing.position for swing in pair if isinstance(swing, JointTrajectory)] for pair in swings]
    assert {len(pair) for pair in found} <= {0, 2}, "both refuse a goal, or neither"
    differences = [np.abs(pair[0] - pair[1]).max() for pair in found if pair]
    assert len(differences) > 50
    assert max(differences) < 1e-6


def test_drawn_goals_make_limits_bind() -> None:
    wide = JointLimits(ARM.lower, ARM.upper, 1e3 * ARM.speed, 1e3 * ARM.acceleration)
    free, limited = Primitive(wide), Primitive(ARM)
    bound = refused = 0
    for goal in draw_goals(ARM, np.random.default_rng(5), 100):
        free_swing = free.trajectory(goal.start, goal.position, goal.velocity, goal.hit_time)
        broken = max(violations(free_swing, ARM).values()) > 1e-6
        try:
            limited.trajectory(goal.start, goal.position, goal.velocity, goal.hit_time)
            bound += broken
        except Infeasible:
            refused += 1
    assert bound > 5
    assert refused < 15


@settings(max_examples=120, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    effort=st.floats(0.05, 2.0),
    hit_time=st.floats(0.05, 3.0),
    amplitude=st.floats(0.0, 8.0),
    room=st.floats(0.02, 3.0),
)
def test_an_accepted_swing_meets_its_equalities_and_limits(
    seed: int, effort: float, hit_time: float, amplitude: float, room: float
) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1.0, 1.0, 6)
    limits = JointLimits(
        start - room * rng.uniform(0.0, 1.0, 6) - 1e-3,
        start + room * rng.uniform(0.0, 1.0, 6) + 1e-3,
        ARM.speed,
        ARM.acceleration,
    )
    reach = effort * np.minimum(limits.speed * hit_time, limits.acceleration * hit_time**2 / 4)
    goal = np.clip(start + rng.uniform(-1.0, 1.0, 6) * reach, limits.lower, limits.upper)
    velocity = np.clip(rng.normal(size=6) * effort, -1.0, 1.0) * np.minimum(
        limits.speed, limits.acceleration * hit_time / 2
    )
    swing = attempt(Primitive(limits, wave(amplitude)), start, goal, velocity, hit_time)
    if isinstance(swing, Infeasible):
        assert swing.reason in ("limits", "out_of_reach")
        return
    assert max(violations(swing, limits).values()) <= 1e-6
    for joint in range(6):
        way, speed = integrate(swing.acceleration[:, joint], hit_time / HIT)
        np.testing.assert_allclose(swing.position[:, joint], start[joint] + way, rtol=0, atol=1e-9)
        np.testing.assert_allclose(swing.velocity[:, joint], speed, rtol=0, atol=1e-9)
    q, qd, _ = swing.sample(np.array([0.0, hit_time, swing.time[-1]]))
    np.testing.assert_allclose(q[:2], [start, goal], rtol=0, atol=1e-6)
    np.testing.assert_allclose(qd, [np.zeros(6), velocity, np.zeros(6)], rtol=0, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(
    way=st.floats(-1.5, 1.5),
    goal_velocity=st.floats(-2.0, 2.0),
    hit_time=st.floats(0.2, 0.9),
    room=st.floats(1.5, 1.6),
    acceleration=st.floats(5.0, 30.0),
)
def test_a_goal_is_refused_only_where_linear_programming_finds_no_swing_either(
    way: float, goal_velocity: float, hit_time: float, room: float, acceleration: float
) -> None:
    limits = one_joint(room=room, acceleration=acceleration)
    to_way, to_velocity = maps(N, hit_time / HIT)

    def exists(slack: float) -> bool:
        quantities = np.vstack([to_velocity, to_way, np.eye(N)])
        bound = np.repeat([limits.speed[0], room, acceleration], N) * (1 + slack)
        if slack < 0:  # the same reserve that the primitive keeps between knots
            quantities = np.vstack([quantities, to_way + 0.5 * hit_time / HIT * to_velocity])
            bound = np.r_[bound, np.full(N, room * (1 + slack))]
        found = linprog(
            np.zeros(N),
            A_ub=np.vstack([quantities, -quantities]),
            b_ub=np.r_[bound, bound],
            A_eq=np.vstack([to_way[HIT - 1], to_velocity[HIT - 1], to_velocity[-1]]),
            b_eq=[way, goal_velocity, 0.0],
            bounds=(None, None),
            method="highs",
        )
        return bool(found.status == 0)

    swing = attempt(Primitive(limits), np.zeros(1), np.array([way]), np.array([goal_velocity]), hit_time)
    if isinstance(swing, Infeasible):
        assert swing.reason in ("limits", "out_of_reach")
        assert not exists(-1e-5)
    else:
        assert exists(1e-5)


@pytest.mark.parametrize(
    ("change", "reason", "joint"),
    [
        ({"start": (2, np.nan)}, "not_finite", 2),
        ({"goal_position": (1, np.inf)}, "not_finite", 1),
        ({"goal_velocity": (0, np.nan)}, "not_finite", 0),
        ({"hit_time": np.nan}, "not_finite", None),
        ({"hit_time": np.inf}, "not_finite", None),
        ({"hit_time": 0.0}, "hit_time", None),
        ({"hit_time": -0.5}, "hit_time", None),
        ({"hit_time": 1e-200}, "hit_time", None),
        ({"hit_time": 1e200}, "hit_time", None),
        ({"start": (2, 3.2)}, "start_position", 2),
        ({"goal_position": (2, -3.2)}, "goal_position", 2),
        ({"goal_velocity": (4, 3.2)}, "goal_velocity", 4),
        ({"goal_position": (5, 2.0)}, "out_of_reach", 5),
        ({"goal_position": (5, -2.0)}, "out_of_reach", 5),
        ({"hit_time": 0.01}, "out_of_reach", 3),
    ],
)
def test_an_impossible_goal_is_refused_with_its_reason_and_joint(
    change: dict[str, object], reason: str, joint: int | None
) -> None:
    arguments: dict[str, object] = {
        "start": HOME,
        "goal_position": HOME + WAY,
        "goal_velocity": SPEED,
        "hit_time": 0.6,
    }
    if reason == "out_of_reach" and joint == 3:  # only this joint has to move
        arguments["goal_velocity"] = np.where(np.arange(6) == 3, SPEED, 0.0)
        arguments["goal_position"] = HOME
    for name, value in change.items():
        if isinstance(value, tuple):
            index, number = value
            array = np.array(arguments[name])
            array[index] = number
            arguments[name] = array
        else:
            arguments[name] = value
    with pytest.raises(Infeasible) as refusal:
        Primitive(ARM).trajectory(**arguments)  # type: ignore[arg-type]  # the table above holds mixed arguments
    assert (refusal.value.reason, refusal.value.joint) == (reason, joint)
    assert refusal.value.details == {"reason": reason, "joint": joint}


def test_a_goal_that_leaves_no_room_behind_it_is_refused_for_its_limits() -> None:
    with pytest.raises(Infeasible, match="joint 0: no motion") as refusal:
        Primitive(one_joint(room=0.3)).trajectory(np.zeros(1), np.array([0.3]), np.array([1.0]), 0.6)
    assert refusal.value.reason == "limits"


def test_a_goal_on_its_position_limit_at_rest_is_met() -> None:
    limits = one_joint(room=0.3)
    swing = Primitive(limits).trajectory(np.zeros(1), np.array([0.3]), np.zeros(1), 0.6)
    assert abs(swing.position[HIT, 0] - 0.3) < 1e-6
    assert max(violations(swing, limits).values()) <= 1e-6


def test_arrays_of_another_shape_are_invalid() -> None:
    with pytest.raises(Invalid, match=r"goal_velocity must have shape \(6,\)"):
        Primitive(ARM).trajectory(HOME, HOME, np.zeros(5), 0.6)
    with pytest.raises(Invalid, match="profile must have shape"):
        Primitive(ARM, np.zeros((N, 5)))
    with pytest.raises(Invalid, match="hit_interval"):
        Primitive(ARM, hit_interval=43)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("upper", [0.0], "lower must be less"),
        ("speed", [0.0], "speed must be positive"),
        ("acceleration", [-1.0], "acceleration must be positive"),
        ("upper", [np.inf], "finite"),
        ("speed", [1.0, 2.0], "shape"),
    ],
)
def test_limits_that_no_joint_can_have_are_invalid(name: str, value: list[float], message: str) -> None:
    fields = {"lower": [0.0], "upper": [1.0], "speed": [1.0], "acceleration": [1.0], name: value}
    with pytest.raises(Invalid, match=message):
        JointLimits(**{key: np.array(entry) for key, entry in fields.items()})


@pytest.mark.parametrize("shortcuts", [True, False])
def test_the_same_goal_gives_bitwise_the_same_swing_whatever_came_before(shortcuts: bool) -> None:
    goals = draw_goals(ARM, np.random.default_rng(8), 12)
    used = Primitive(ARM, wave(5.0), shortcuts=shortcuts)

    def accelerations(primitive: Primitive, index: int) -> bytes:
        goal = goals[index]
        try:
            swing = primitive.trajectory(goal.start, goal.position, goal.velocity, goal.hit_time)
        except Infeasible as refusal:
            return str(refusal).encode()
        return swing.acceleration.tobytes() + swing.position.tobytes()

    in_order = [accelerations(used, index) for index in range(12)]
    backwards = [accelerations(used, index) for index in reversed(range(12))]
    fresh = [accelerations(Primitive(ARM, wave(5.0), shortcuts=shortcuts), index) for index in range(12)]
    assert in_order == backwards[::-1] == fresh
