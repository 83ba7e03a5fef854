"""`gymnasium_skill`: a Gymnasium environment as a skill."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, final

import gymnasium
import numpy as np

from crkr.protocol import Array, Geom, Invalid, TaskSpec
from crkr.sim_worker.gymnasium.environment import Bounds, Environment, make_environment
from crkr.sim_worker.gymnasium.judgement import Cost, Episode, Judgement, Measure, Success, judge_by
from crkr.sim_worker.gymnasium.motion import Motion, motion_for
from crkr.sim_worker.gymnasium.mujoco_scene import MujocoScene
from crkr.sim_worker.gymnasium.observation import Observation
from crkr.sim_worker.primitives import Infeasible
from crkr.sim_worker.skill import SkillFactory, SkillOptions, TrialResult
from crkr.sim_worker.skill_registry import task_name

__all__ = ["GymnasiumSkill", "gymnasium_skill"]

logger = logging.getLogger(__name__)

RESETS: Final = 100
"""Resets that define the state's box, with fixed seeds so that every worker finds the same task."""
TRIES: Final = 1000
"""Random goals of which one must be possible."""
EPISODES: Final = 40
"""Random episodes that define the cost of a return by default."""


def gymnasium_skill(
    environment: str | Callable[[], gymnasium.Env[Any, Any]],
    *,
    state: Sequence[str | int] | None = None,
    goal_bounds: Bounds | None = None,
    success: Success | None = None,
    cost: Cost | None = None,
    outcome: Measure | None = None,
    tolerance: float | Mapping[str, float] | None = None,
    via_points: int | None = None,
    steps: int | None = None,
    start: int = 0,
    settings: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> SkillFactory:
    """Makes a skill of an environment: the state varies at reset, a goal is the motion of one episode.

    `crkr workers gymnasium:ENV-ID` does the same without arguments.

    Args:
        environment: Its name, as "Reacher-v5" or "package:ENV-ID"; or what makes it.
        state: Numbers of the observation to keep, by name ("desired_goal", "observation_4") or position; by default all
            that vary and are not functions of others.
        goal_bounds: Narrower ones than of the environment's actions or joints, or of actions that have none: the
            greatest size, or (low, high), each a number or one for each.
        success: A flag of the environment's info, "is_success" unless given; or a function of environment and info.
        cost: ("return", WORST, BEST), the returns that cost 1 and 0; or a function of environment and info. By default
            the outcome decides, or the returns of 40 random episodes.
        outcome: Measures by how much a trial was off: signed numbers by name, 0 is perfect. The default is the
            difference of desired and achieved goal, if the environment has them.
        tolerance: Size of the outcome's numbers that still succeeds; one for all, or by name.
        via_points: Number of points that actions pass. Unless given, joints of MuJoCo models make a stroke to the
            goal's joint positions, and other actions stay the same during an episode.
        steps: Of an episode, where the environment has no time limit.
        start: Trials that fill the goal's bounds before learning.
        settings: Further fields of the task's specification.
        arguments: Passed to the environment.

    Returns:
        A factory for `crkr workers FILE:NAME`; it raises `Invalid`, which says what to do, for an environment that
        cannot be a skill.
    """

    def factory(options: SkillOptions) -> GymnasiumSkill:
        asked = {"environment": options.environment, "launcher": options.launcher, "preset": options.preset}
        for option, value in asked.items():
            if value is not None:
                raise Invalid(f"a Gymnasium environment has no --{option}; leave it out")
        made = make_environment(environment, arguments, goal_bounds, steps)
        resets = [made.env.reset(seed=seed)[0] for seed in range(RESETS)]
        observation = Observation.choose(made.env.observation_space, resets, state, made.name)
        trials = _Trials(made, motion_for(made, via_points, goal_bounds))
        judgement = judge_by(
            trials.random(0),
            lambda: np.array([trials.random(seed).total for seed in range(EPISODES)]),
            made.name,
            success=success,
            cost=cost,
            outcome=outcome,
            tolerance=tolerance,
        )
        spec = TaskSpec.from_dict(
            {
                "name": options.name or task_name(made.name),
                "seed": options.seed,
                "description": f"Gymnasium's {made.name}; {judgement.rule}.",
                "state": list(observation.axes),
                "goal": trials.motion.axes,
                "outcome": judgement.axes,
                "start": {"type": "space-filling", "count": start},
                **(settings or {}),
            },
            strict=True,
        )
        logger.info("%s: %s", made.name, judgement.rule)
        return GymnasiumSkill(spec, observation, trials, judgement)

    return factory


@final
class _Trials:
    """Episodes of an environment, each decided by a goal at its start."""

    def __init__(self, environment: Environment, motion: Motion) -> None:
        self.environment = environment
        self.motion = motion
        self.scene = MujocoScene(environment.env.unwrapped)
        low, high = zip(*((axis["low"], axis["high"]) for axis in motion.axes), strict=True)
        self._box = np.array(low), np.array(high)

    def run(self, goal: Array) -> Episode:
        """The episode of a goal (p,) from the current reset on; raises `Infeasible` for a goal that cannot be tried."""
        actions = self.motion.begin(goal)
        self.scene.clear()
        total, observation = 0.0, None
        info: Mapping[str, Any] = {}
        for step in range(self.environment.steps):
            observation, reward, over, info = self.environment.act(actions(step))
            total += reward
            self.scene.record()
            if over:
                break
        return Episode(self.environment.env.unwrapped, observation, total, info)

    def random(self, seed: int) -> Episode:
        """The episode of a goal drawn from the bounds, the first that can be tried; `Invalid` where none can."""
        rng = np.random.default_rng(seed)
        for _ in range(TRIES):
            self.environment.env.reset(seed=seed)
            try:
                return self.run(rng.uniform(*self._box))
            except Infeasible as infeasible:
                reason = infeasible.reason
        raise Invalid(
            f"{self.environment.name}: none of {TRIES} goals within the bounds can be tried ({reason}); "
            "give other goal_bounds, or via_points"
        )


@final
class GymnasiumSkill:
    """A skill that `gymnasium_skill` makes; implements `Skill` and `HasScene`."""

    def __init__(self, spec: TaskSpec, observation: Observation, trials: _Trials, judgement: Judgement) -> None:
        self._spec = spec
        self._observation = observation
        self._trials = trials
        self._judgement = judgement
        self._seed = 0
        self._fresh = False

    def spec(self) -> TaskSpec:
        """The task's specification."""
        return self._spec

    def reset(self, rng: np.random.Generator) -> Array:
        """Resets the environment with a seed drawn from `rng`; the state (d,)."""
        self._seed = int(rng.integers(2**31))
        return self._observation.state(self._reset())

    def execute(self, goal: Array) -> TrialResult:
        """Runs an episode; a second goal starts from the same reset again."""
        if not self._fresh:
            self._reset()
        self._fresh = False
        try:
            episode = self._trials.run(np.asarray(goal, dtype=np.float64))
        except Infeasible as infeasible:
            return TrialResult(None, False, False, None, {"reason": infeasible.reason})
        success = self._judgement.success(episode)
        info = {"reason": "success" if success else "miss", "return": episode.total}
        cost, outcome = self._judgement.cost(episode), self._judgement.outcome(episode)
        return TrialResult(cost, success, True, outcome, info, self._trials.scene.trace())

    def scene(self) -> Sequence[Geom]:
        """Shapes of the MuJoCo model; empty without one."""
        return self._trials.scene.shapes()

    def _reset(self) -> Any:
        self._fresh = True
        return self._trials.environment.env.reset(seed=self._seed)[0]
