"""The skill: a six-joint arm returns table tennis balls."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, final

import numpy as np

from crkr.protocol import Array, Geom, Invalid
from crkr.sim_worker.arm.arm_skill import ArmSkill, RefusedGoal, choice
from crkr.sim_worker.arm.collision import MARGIN
from crkr.sim_worker.primitives.profiles import demonstrated_profile, wind_up
from crkr.sim_worker.primitives.stroke import JointTrajectory, Primitive
from crkr.sim_worker.simulation.motion import trace
from crkr.sim_worker.simulation.simulation import Diverged
from crkr.sim_worker.skill import Film, SkillOptions, TrialResult
from crkr.sim_worker.table_tennis.ball.constants import FACE_OFFSET
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS, Launcher
from crkr.sim_worker.table_tennis.environments.environments import ENVIRONMENTS, make_environment, make_predictor
from crkr.sim_worker.table_tennis.environments.play import Play
from crkr.sim_worker.table_tennis.planner import HOME, Planner, Predictor
from crkr.sim_worker.table_tennis.scene import make_arm, make_check, make_simulation
from crkr.sim_worker.table_tennis.spec import task_spec
from crkr.sim_worker.table_tennis.tracker import judge, motion

__all__ = ["ENVIRONMENTS", "TableTennis"]

CRITERIA: Final = {"tuned": "strict", "paper": "paper"}  # the success that each preset learns from
CLEAREST: Final = 0.3  # [m]; larger values count as this

_log = logging.getLogger(__name__)


@final
class TableTennis(ArmSkill):
    """Table tennis against a launcher (satisfies `Skill`). One object serves one thread.

    State (6,): ball position [m] and velocity [m/s] as it passes x = +0.5 m, in the table frame.
    Goal (13,): joint positions [rad] and velocities [rad/s] at the hit, and the hit's time after the snapshot [s].

    Args:
        options: Environment "contact", "hybrid" or "analytic"; launcher "nominal", "medium" or "wide"; preset "tuned"
            or "paper".
        traces: False leaves `TrialResult.trace` empty, which saves half a millisecond a trial.
        profiled: Swings follow the acceleration profile of a recorded demonstration with a wind-up instead of the
            smallest accelerations that reach the goal.
        magnus: Spin lifts the ball.
        cautious: Refuse swings in which the arm would touch itself.

    Raises:
        Invalid: An option with an unknown name.
    """

    def __init__(
        self,
        options: SkillOptions,
        *,
        traces: bool = True,
        profiled: bool = False,
        magnus: bool = False,
        cautious: bool = False,
    ) -> None:
        self._name = choice("table tennis", "environment", options.environment or "contact", ENVIRONMENTS)
        name = choice("table tennis", "launcher", options.launcher or "nominal", LAUNCHERS)
        preset = choice("table tennis", "preset", options.preset or "tuned", CRITERIA)
        self._launcher: Launcher = LAUNCHERS[name]
        self._criterion = CRITERIA[preset]
        spec = task_spec(self._launcher, preset, options.name, options.seed)
        options = replace(options, environment=self._name, launcher=name, preset=preset)
        super().__init__(spec, options, self._launcher, make_arm(), HOME, _aim)
        self._magnus = magnus
        self._simulation = make_simulation(magnus=magnus)
        self._environment = make_environment(self._name, self._arm, self._simulation, magnus=magnus)
        self._collision = make_check(self._arm, itself=cautious)
        self._obstacles = "the table, the net or itself" if cautious else "the table or the net"
        self._planner: Planner | None = None
        self._predictor: Predictor | None = None
        self._traces = traces and options.traces
        self.diverged = 0  # trials whose simulation failed
        if profiled:
            self._primitive = Primitive(self._primitive.limits, self._recorded_profile())

    def execute(self, goal: Array) -> TrialResult:
        """Swings at the ball of the last `reset`.

        The outcome (7,) is the ball minus the point of the paddle's face at the hit time (3,), the landing point minus
        the aim (2,) [m], the time to spare [s] and the arm's least distance to the table [m]; NaN: not observed. For a
        refused goal, the planned paddle counts.

        A refused goal gives the reason "invalid" (shape, NaN or bounds), "infeasible" (no swing within the joint
        limits) or "collision" (within 1 cm of table or net); a failed simulation gives "diverged".

        Raises:
            Invalid: There was no `reset` before.
        """
        return self.attempt(self._situation, goal)

    def attempt(self, ball: Array, goal: Array) -> TrialResult:
        """As `execute`, for any ball (6,)."""
        try:
            swing, clearance = self._swing(goal)
            play = self._executed(ball, swing, float(goal[12]))
        except RefusedGoal as refusal:
            return self._measured(refusal, ball, goal)
        verdict = judge(play)
        outcomes = {"paper": verdict.paper, "strict": verdict.strict}
        return TrialResult(
            cost=verdict.cost,
            success=outcomes[self._criterion],
            executed=True,
            outcome=np.array([*verdict.outcome, self._spare_time(goal), min(clearance, CLEAREST)]),
            info={"reason": verdict.reason, "outcomes": outcomes},
            trace=trace(self._simulation, motion(swing, play, verdict)) if self._traces else None,
        )

    def film(self, goal: Array, interval: float) -> Film | None:
        """The motion of `execute`, in steps of at most `interval` [s], for drawing; None where the goal is refused."""
        try:
            swing, play = self._play(self._situation, goal)
        except RefusedGoal:
            return None
        return Film(trace(self._simulation, motion(swing, play, judge(play), interval)), play.hit_time)

    def draw_policy(self, figure: Any, states: Array, goals: Array, index: int) -> None:
        """Draws where and how the paddle of goals (n, 13) would meet the ball as one coordinate of the state varies."""
        from crkr.sim_worker.table_tennis.policy_figure import draw_hits  # workers need no Matplotlib

        axis = self._spec.state[index]
        draw_hits(figure, self._arm, f"{axis.name} [{axis.unit}]", states[:, index], goals)

    def plan(self, ball: Array) -> tuple[Array, TrialResult] | None:
        """The planner's first goal (13,) that returns `ball` (6,) by the strict criterion, and its result."""
        plans = list(self._plans(ball))
        return plans[-1] if plans and plans[-1][1].info["outcomes"]["strict"] else None

    def best_plan(self, ball: Array) -> dict[str, bool]:
        """Whether some plan for `ball` (6,) succeeds, by each criterion."""
        tried = [result.info["outcomes"] for _, result in self._plans(ball, early=True)]
        return {criterion: any(outcomes[criterion] for outcomes in tried) for criterion in CRITERIA.values()}

    def _plans(self, ball: Array, *, early: bool = False) -> Iterator[tuple[Array, TrialResult]]:
        """The planner's goals for `ball` with their results, up to the first strict success."""
        if self._planner is None:
            self._planner = Planner(self._arm, make_predictor(self._name, magnus=self._magnus))
        for goal in self._planner.goals(ball, early=early):
            result = self.attempt(ball, goal)
            yield goal, result
            if result.info["outcomes"]["strict"]:
                return

    def _recorded_profile(self) -> Array:
        """The profile (N, 6) of a demonstration with a wind-up at the launcher's central ball, as measured there."""
        ball = np.array(self._launcher.centre)
        plan = self.plan(ball)
        if plan is None:
            raise Invalid(f"the planner cannot return the central ball of launcher {self._launcher.name!r}")
        speeds, hit_time = plan[0][6:12], float(plan[0][12])
        self._primitive = Primitive(self._primitive.limits, wind_up(speeds, hit_time))
        _, play = self._play(ball, plan[0])
        return demonstrated_profile(play.time, play.joints, play.hit_time)

    def scene(self) -> Sequence[Geom]:
        """Table, net, floor, pedestal, arm, paddle and ball."""
        return self._simulation.geoms()

    def _measured(self, refusal: RefusedGoal, ball: Array, goal: Array) -> TrialResult:
        """The result of a refused goal, with the known outcomes: the planned miss, spare time and clearance."""
        outcomes = {"paper": False, "strict": False}
        if refusal.reason in ("invalid", "diverged"):
            return refusal.result(outcomes=outcomes)
        if self._predictor is None:
            self._predictor = make_predictor(self._name, magnus=self._magnus)
        goal = np.asarray(goal, dtype=np.float64)
        try:
            path = self._predictor.path(ball, float(goal[12]) + 2 * self._predictor.timestep)
        except Diverged:
            return refusal.result(outcomes=outcomes)
        row = min(round(float(goal[12]) / self._predictor.timestep), len(path) - 1)
        paddle = self._arm.tool(goal[:6], goal[6:12])
        miss = path[row, :3] - (paddle.position + FACE_OFFSET * paddle.normal)
        outcome = np.array([*miss, np.nan, np.nan, self._spare_time(goal), min(refusal.clearance, CLEAREST)])
        return refusal.result(outcome, outcomes=outcomes)

    def _play(self, ball: Array, goal: Array) -> tuple[JointTrajectory, Play]:
        swing, _ = self._swing(goal)
        return swing, self._executed(ball, swing, float(goal[12]))

    def _swing(self, goal: Array) -> tuple[JointTrajectory, float]:
        """The swing, and its least distance to the table [m]."""
        swing = self._stroke(goal)
        rows = _between(swing)
        clearance, row = self._collision.clearance(rows)
        if clearance >= MARGIN:
            touched = self._collision.first(rows)
            if touched is None:
                return swing, clearance
            row = touched
        raise RefusedGoal("collision", f"the arm would touch {self._obstacles} at sample {row} of the swing", clearance)

    def _executed(self, ball: Array, swing: JointTrajectory, hit_time: float) -> Play:
        try:
            return self._environment.play(ball, swing, hit_time)
        except Diverged as error:
            self.diverged += 1
            _log.warning("trial dropped (%d so far): %s", self.diverged, error)
            raise RefusedGoal("diverged", str(error)) from error


def _between(swing: JointTrajectory) -> Array:
    """Joint positions at the knots and half-way between them."""
    position, half = swing.position, 0.5 * np.diff(swing.time)[:, None]
    rows = np.empty((2 * len(position) - 1, position.shape[1]))
    rows[::2] = position
    rows[1::2] = position[:-1] + half * (swing.velocity[:-1] + 0.5 * half * swing.acceleration)
    return rows


def _aim(goal: Array) -> tuple[Array, Array, float]:
    """Joint positions [rad] and velocities [rad/s] at the hit, and its time [s]."""
    return goal[:6], goal[6:12], float(goal[12])
