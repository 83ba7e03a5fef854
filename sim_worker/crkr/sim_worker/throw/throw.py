"""The skill: a six-joint arm throws a ball over a wall into a bin."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, final

import numpy as np

from crkr.protocol import Array, Geom, Trace
from crkr.sim_worker.arm.arm_skill import ArmSkill, RefusedGoal, choice
from crkr.sim_worker.arm.collision import MARGIN
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.flight import Ball
from crkr.sim_worker.simulation.motion import INTERVAL, trace
from crkr.sim_worker.simulation.simulation import Diverged
from crkr.sim_worker.skill import Film, SkillOptions, TrialResult
from crkr.sim_worker.throw.environments import (
    ENVIRONMENTS,
    Flight,
    make_arm,
    make_check,
    make_environment,
    make_simulation,
)
from crkr.sim_worker.throw.layouts import LAUNCHERS, Layout
from crkr.sim_worker.throw.outcome import Passage, reason_of
from crkr.sim_worker.throw.planner import HOME, Planner, full_goal
from crkr.sim_worker.throw.spec import task_spec

__all__ = ["Throw"]

PRESETS: Final = ("tuned",)

_log = logging.getLogger(__name__)


@final
class Throw(ArmSkill):
    """Throws in the situations of a launcher (satisfies `Skill`). One object serves one thread.

    State (4,): the bin's x and y, the wall's x, and its height [m].
    Goal (8,): shoulder pan, shoulder lift, elbow and wrist 1 at the release [rad], the speeds of the last three
    [rad/s], and the time of the release [s].

    Args:
        options: Environment "contact" or "analytic"; launcher "nominal" or "wide"; preset "tuned".
        traces: False leaves `TrialResult.trace` empty, which saves time.

    Raises:
        Invalid: An option with an unknown name.
    """

    def __init__(self, options: SkillOptions, *, traces: bool = True) -> None:
        name = choice("the throw", "environment", options.environment or "contact", ENVIRONMENTS)
        launcher = LAUNCHERS[choice("the throw", "launcher", options.launcher or "nominal", LAUNCHERS)]
        preset = choice("the throw", "preset", options.preset or "tuned", PRESETS)
        spec = task_spec(launcher, options.name, options.seed)
        options = replace(options, environment=name, launcher=launcher.name, preset=preset)
        super().__init__(spec, options, launcher, make_arm(), HOME, full_goal)
        self._simulation = make_simulation()
        self._environment = make_environment(name, self._arm, self._simulation)
        self._check = make_check(self._arm)
        self._planner = Planner(self._arm, self._primitive.limits)
        self._traces = traces and options.traces

    def execute(self, goal: Array) -> TrialResult:
        """Throws in the situation of the last `reset`.

        The outcome (4,) is the ball minus the bin's middle where it comes down to the rim (2,) and its height over the
        wall [m], both for a free flight, and the spare time [s]; NaN: not observed. For a refused goal, the planned
        release counts.

        A refused goal gives the reason "invalid" (shape, NaN or bounds), "infeasible" (no swing within the joint
        limits) or "collision" (the arm would come within 1 cm of the floor or itself); a failed simulation gives
        "diverged".

        Raises:
            Invalid: There was no `reset` before.
        """
        return self.attempt(self._situation, goal)

    def attempt(self, state: Array, goal: Array) -> TrialResult:
        """As `execute`, for any state (4,)."""
        layout = Layout.of(state)
        try:
            swing = self._swing(goal)
            flight = self._thrown(layout, swing, goal)
        except RefusedGoal as refusal:
            return self._measured(refusal, layout, goal)
        passage = flight.passage
        return TrialResult(
            cost=passage.cost,
            success=flight.inside,
            executed=True,
            outcome=np.array([*passage.miss, passage.clearance, self._spare_time(goal)]),
            info={"reason": reason_of(passage, flight.inside)},
            trace=self._trace(layout, flight, INTERVAL) if self._traces else None,
        )

    def film(self, goal: Array, interval: float) -> Film | None:
        """The motion of `execute`, in steps of at most `interval` [s], for drawing; None where the goal is refused."""
        layout = Layout.of(self._situation)
        try:
            swing = self._swing(goal)
            return Film(self._trace(layout, self._thrown(layout, swing, goal), interval), float(goal[7]))
        except RefusedGoal:
            return None

    def draw_policy(self, figure: Any, states: Array, goals: Array, index: int) -> None:
        """Draws how goals (n, 8) would throw as one coordinate of the state varies."""
        from crkr.sim_worker.throw.policy_figure import draw_throws  # workers need no Matplotlib

        axis = self._spec.state[index]
        draw_throws(figure, self._arm, f"{axis.name} [{axis.unit}]", states[:, index], states, goals)

    def plan(self, state: Array) -> tuple[Array, TrialResult] | None:
        """The planner's first goal (8,) that succeeds in a state (4,), and its result."""
        tried = ((goal, self.attempt(state, goal)) for goal in self._planner.goals(Layout.of(state)))
        return next(((goal, result) for goal, result in tried if result.success), None)

    def best_plan(self, state: Array) -> dict[str, bool]:
        """Whether some plan for a state (4,) succeeds."""
        return {"success": self.plan(state) is not None}

    def scene(self) -> Sequence[Geom]:
        """Floor, pedestal, arm, gripper, wall, bin and ball."""
        return self._simulation.geoms()

    def _swing(self, goal: Array) -> JointTrajectory:
        swing = self._stroke(goal)
        clearance, row = self._check.clearance(swing.position[::2])
        if clearance < MARGIN:
            detail = f"the arm would touch the floor or itself at knot {2 * row} of the swing"
            raise RefusedGoal("collision", detail)
        return swing

    def _thrown(self, layout: Layout, swing: JointTrajectory, goal: Array) -> Flight:
        try:
            return self._environment.throw(layout, swing, float(goal[7]))
        except Diverged as error:
            _log.warning("trial dropped: %s", error)
            raise RefusedGoal("diverged", str(error)) from error

    def _measured(self, refusal: RefusedGoal, layout: Layout, goal: Array) -> TrialResult:
        """The result of a refused goal, with the known outcomes: the planned passage and spare time."""
        if refusal.reason in ("invalid", "diverged"):
            return refusal.result()
        position, speed, _ = full_goal(np.asarray(goal, dtype=np.float64))
        grip = self._arm.tool(position, speed)
        passage = Passage.of(Ball(*grip.position.tolist(), *grip.velocity.tolist()), layout)
        outcome = np.array([*passage.miss, passage.clearance, self._spare_time(goal)])
        return refusal.result(outcome)

    def _trace(self, layout: Layout, flight: Flight, interval: float) -> Trace:
        self._simulation.place("wall", layout.wall)
        self._simulation.place("bin", layout.bin)
        return trace(self._simulation, flight.motion.resampled(interval))
