"""The skill as workers use it."""

from collections.abc import Callable

import numpy as np
import pytest

from crkr.client.tally import Tally
from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.table_tennis import TableTennis, make, make_cautious
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS


@pytest.fixture
def played(skill: TableTennis) -> tuple[TableTennis, np.ndarray, np.ndarray]:
    """The skill with a ball in the air, that ball, and a goal that returns it."""
    ball = skill.reset(np.random.default_rng(5))
    plan = skill.plan(ball)
    assert plan is not None
    return skill, ball, plan[0]


def test_it_is_a_skill() -> None:
    skill: Skill = make(SkillOptions(name="rally", seed=3))
    assert (skill.spec().name, skill.spec().seed) == ("rally", 3)
    assert len(skill.spec().state) == 6
    assert len(skill.spec().goal) == 13


@pytest.mark.parametrize("preset", ["tuned", "paper"])
def test_a_spec_survives_the_wire(preset: str) -> None:
    spec = TableTennis(SkillOptions(preset=preset)).spec()
    assert TaskSpec.from_dict(spec.to_dict()) == spec


def test_the_papers_preset_is_the_papers_method() -> None:
    spec = TableTennis(SkillOptions(preset="paper")).spec()
    assert (spec.kernel.linear_weight, spec.cost_map, spec.learn_from) == (0.0, "linear", "successes")
    assert (spec.prior_mean, spec.budget, spec.exploration.type) == ("zero", 250, "gaussian")


@pytest.mark.parametrize(
    "options", [SkillOptions(environment="moon"), SkillOptions(launcher="cannon"), SkillOptions(preset="best")]
)
def test_an_unknown_option_is_refused_with_what_there_is(options: SkillOptions) -> None:
    with pytest.raises(Invalid, match="there are"):
        make(options)


def test_the_planner_returns_nearly_every_nominal_ball(planned_returns: Callable[..., Tally]) -> None:
    tally = planned_returns("nominal", 40, seed=12)
    assert tally.rate("strict") >= 0.95
    assert tally.rate("paper") >= tally.rate("strict")


def test_demonstrations_succeed_for_balls_that_differ(skill: TableTennis) -> None:
    shown = skill.demonstrations(5, np.random.default_rng(0))
    assert len(shown) == 5
    for demonstration in shown:
        assert demonstration.result.executed
        assert demonstration.result.success
        assert demonstration.result.cost is not None
        assert demonstration.result.cost < 0.01
        again = skill.attempt(demonstration.state, demonstration.goal)
        assert again.cost == demonstration.result.cost


def test_demonstrations_are_of_the_launchers_next_balls_that_can_be_returned(skill: TableTennis) -> None:
    shown = [demonstration.state.tobytes() for demonstration in skill.demonstrations(5, np.random.default_rng(0))]
    rng = np.random.default_rng(0)
    drawn = [LAUNCHERS["nominal"].draw(rng) for _ in range(20)]
    returned = [ball.tobytes() for ball in drawn if skill.plan(ball) is not None]
    assert shown == returned[:5]


def test_the_same_seed_demonstrates_the_same(skill: TableTennis) -> None:
    first, second = (skill.demonstrations(2, np.random.default_rng(4)) for _ in range(2))
    assert [d.goal.tobytes() for d in first] == [d.goal.tobytes() for d in second]


def test_the_same_ball_and_goal_give_the_same_bits(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    skill, ball, goal = played
    first = skill.execute(goal)
    skill.attempt(ball, goal * (1 + 1e-3))
    other = TableTennis(SkillOptions()).attempt(ball, goal)
    for outcome in (skill.execute(goal), other):
        assert outcome.cost == first.cost
        assert outcome.outcome is not None
        assert first.outcome is not None
        assert outcome.outcome.tobytes() == first.outcome.tobytes()


def test_a_good_goal_succeeds_and_a_bent_one_misses(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    skill, _, goal = played
    good = skill.execute(goal)
    assert good.success
    assert good.info["reason"] == "returned"
    bent = skill.execute(goal + np.array([0.25] + [0.0] * 12))
    assert bent.executed
    assert not bent.success
    assert bent.info["reason"] == "miss"
    assert bent.cost is not None
    assert bent.cost > 0.9
    assert bent.outcome is not None
    assert np.isnan(bent.outcome).tolist() == [False] * 3 + [True] * 2 + [False] * 2


def test_striking_too_early_costs_but_the_miss_is_measured_on_the_untouched_flight(
    played: tuple[TableTennis, np.ndarray, np.ndarray],
) -> None:
    skill, ball, goal = played
    late = goal.copy()
    late[12] += 0.03
    later = skill.attempt(ball, late)
    assert later.executed
    assert later.outcome is not None
    assert later.cost is not None
    assert later.cost > 0.5
    # The ball moves on by its speed times the delay, had nothing been in its way.
    assert later.outcome[0] == pytest.approx(0.03 * -3.0, abs=0.03)


def test_a_swing_without_time_is_infeasible(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    skill, _, goal = played
    hasty = goal.copy()
    hasty[12], hasty[0] = 0.25, skill.spec().bounds[1][0]
    _refused(skill, hasty, "infeasible")


def test_a_swing_through_the_table_is_a_collision(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    skill, _, goal = played
    low = goal.copy()
    low[1] += 0.5
    _refused(skill, low, "collision")


def test_a_swing_into_the_arm_itself_is_a_collision_for_the_cautious_only(
    played: tuple[TableTennis, np.ndarray, np.ndarray],
) -> None:
    _, ball, goal = played
    options, rng = SkillOptions(environment="analytic"), np.random.default_rng(0)
    bold, cautious = TableTennis(options, traces=False), make_cautious(options)
    assert isinstance(cautious, TableTennis)
    good = cautious.attempt(ball, goal)
    assert good.cost == bold.attempt(ball, goal).cost
    wild = (goal + rng.normal(size=13) * ([0.3] * 6 + [0.5] * 6 + [0.01]) for _ in range(3000))
    refused = (bent for bent in wild if _differ(bold, cautious, ball, bent))
    found = cautious.attempt(ball, next(refused))
    assert (found.executed, found.info["reason"]) == (False, "collision")
    assert "itself" in found.info["detail"]


def _differ(bold: TableTennis, cautious: TableTennis, ball: np.ndarray, goal: np.ndarray) -> bool:
    return bold.attempt(ball, goal).executed and not cautious.attempt(ball, goal).executed


@pytest.mark.parametrize("bad", [np.nan, np.inf, 100.0])
def test_a_goal_that_is_not_finite_or_out_of_bounds_is_refused(
    played: tuple[TableTennis, np.ndarray, np.ndarray], bad: float
) -> None:
    skill, _, goal = played
    wrong = goal.copy()
    wrong[4] = bad
    _refused(skill, wrong, "invalid")


def test_a_goal_of_another_shape_is_refused(skill: TableTennis) -> None:
    skill.reset(np.random.default_rng(0))
    _refused(skill, np.zeros(5), "invalid")


def test_a_breakdown_of_the_simulator_is_reported_counted_and_forgotten(
    played: tuple[TableTennis, np.ndarray, np.ndarray],
) -> None:
    skill, ball, goal = played
    before, count = skill.execute(goal), skill.diverged
    absurd = ball.copy()
    absurd[3:] = 1e12
    outcome = skill.attempt(absurd, goal)
    assert (outcome.executed, outcome.cost, outcome.info["reason"]) == (False, None, "diverged")
    assert skill.diverged == count + 1
    assert skill.execute(goal).cost == before.cost


def test_executing_before_a_reset_is_a_mistake() -> None:
    with pytest.raises(Invalid, match="reset"):
        TableTennis(SkillOptions()).execute(np.zeros(13))


def test_a_trace_shows_the_swing_and_the_ball_until_it_lands(
    played: tuple[TableTennis, np.ndarray, np.ndarray],
) -> None:
    skill, ball, goal = played
    trace = skill.execute(goal).trace
    assert trace is not None
    frames, bodies = len(trace.time), len(trace.bodies)
    assert trace.positions.shape == (frames, bodies, 3)
    assert trace.quaternions.shape == (frames, bodies, 4)
    assert np.linalg.norm(trace.quaternions, axis=2) == pytest.approx(np.ones((frames, bodies)))
    assert np.diff(trace.time).max() <= 1 / 30 + 1e-9
    assert (np.diff(trace.time) > 0).all()
    path = trace.paths["ball"]
    assert path[0] == pytest.approx(ball[:3])
    assert path[-1, 2] == pytest.approx(0.78, abs=1e-4)
    assert path[-1, 0] > 0
    assert trace.positions[:, trace.bodies.index("ball")] == pytest.approx(path)
    assert {geom.body for geom in skill.scene()} <= {"world", *trace.bodies}


def test_without_traces_trials_are_the_same(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    skill, ball, goal = played
    bare = TableTennis(SkillOptions(traces=False)).attempt(ball, goal)
    assert bare.trace is None
    assert bare.cost == skill.attempt(ball, goal).cost


def test_a_recorded_profile_changes_the_swing_but_not_where_it_hits(
    played: tuple[TableTennis, np.ndarray, np.ndarray],
) -> None:
    plain, ball, goal = played
    profiled = TableTennis(SkillOptions(), profiled=True)
    assert profiled.attempt(ball, goal).success
    hands = []
    for skill in (plain, profiled):
        skill.restore(ball)
        film = skill.film(goal, 0.01)
        assert film is not None
        hands.append(film.trace.positions[: int(goal[12] / 0.01), film.trace.bodies.index("wrist_3")])
    apart = np.linalg.norm(hands[0] - hands[1], axis=1)
    assert apart.max() > 0.01
    assert apart[-1] < 0.2 * apart.max()


def test_lift_moves_the_return(played: tuple[TableTennis, np.ndarray, np.ndarray]) -> None:
    plain, ball, goal = played
    lifted = TableTennis(SkillOptions(), magnus=True).attempt(ball, goal)
    assert lifted.executed
    straight = plain.attempt(ball, goal)
    assert lifted.outcome is not None
    assert straight.outcome is not None
    assert 0.005 < np.nanmax(np.abs(lifted.outcome - straight.outcome)) < 1.0


def _refused(skill: TableTennis, goal: np.ndarray, reason: str) -> None:
    outcome = skill.execute(goal)
    assert outcome.info["reason"] == reason
    assert outcome.info["outcomes"] == {"paper": False, "strict": False}
    assert (outcome.executed, outcome.success, outcome.cost, outcome.trace) == (False, False, None, None)
    assert (outcome.outcome is None) == (reason == "invalid")


def test_options_in_force_name_the_skills_choices() -> None:
    options = TableTennis(SkillOptions(launcher="medium")).options
    assert (options.environment, options.launcher, options.preset) == ("contact", "medium", "tuned")
