"""The common part of the arm's skills: options, situations, strokes to a goal, refused goals, demonstrations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final, Protocol

import numpy as np

from crkr.protocol import Array, Invalid, TaskSpec
from crkr.sim_worker.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS, Arm
from crkr.sim_worker.primitives.joint_motion import JointLimits, JointTrajectory, spare_time
from crkr.sim_worker.primitives.stroke import Infeasible, Primitive
from crkr.sim_worker.skill import Demonstration, SkillOptions, TrialResult

__all__ = ["ArmSkill", "RefusedGoal", "choice"]

SPARE_TIMES: Final = (-0.5, 0.3)  # [s]; larger values count as this
DRAWS: Final = 20  # most situations tried per demonstration


class Launcher(Protocol):
    """A distribution of situations."""

    def draw(self, rng: np.random.Generator) -> Array:
        """One situation (d,)."""


class RefusedGoal(Exception):
    """A goal that was not executed or could not be measured.

    Attributes:
        reason: "invalid", "infeasible", "collision" or "diverged".
        detail: In words.
        clearance: The arm's least distance to what it must not touch [m]; NaN: not measured.
    """

    def __init__(self, reason: str, detail: str, clearance: float = np.nan) -> None:
        super().__init__(detail)
        self.reason, self.detail, self.clearance = reason, detail, clearance

    def result(self, outcome: Array | None = None, **info: Any) -> TrialResult:
        """The trial's result, with the known part of its outcome (q,)."""
        told = {"reason": self.reason, "detail": self.detail, **info}
        return TrialResult(cost=None, success=False, executed=False, outcome=outcome, info=told)


class ArmSkill(ABC):
    """Base of skills in which the arm makes one stroke from its home to a goal.

    Args:
        spec: The task specification.
        options: The options in force.
        launcher: Draws situations.
        arm: The arm.
        home: (6,) joint positions before the stroke [rad].
        aim: Returns a goal's joint positions (6,) [rad], velocities (6,) [rad/s] and time [s].
    """

    def __init__(
        self,
        spec: TaskSpec,
        options: SkillOptions,
        launcher: Launcher,
        arm: Arm,
        home: Array,
        aim: Callable[[Array], tuple[Array, Array, float]],
    ) -> None:
        self._spec, self._options, self._draws, self._arm = spec, options, launcher, arm
        self._home, self._aim = home, aim
        self._low, self._high = spec.bounds
        self._primitive = Primitive(JointLimits(arm.lower, arm.upper, SPEED_LIMITS, ACCELERATION_LIMITS))
        self._state: Array | None = None

    def spec(self) -> TaskSpec:
        """The task specification."""
        return self._spec

    @property
    def options(self) -> SkillOptions:
        """The options in force."""
        return self._options

    def reset(self, rng: np.random.Generator) -> Array:
        """Draws a situation (d,), which the next `execute` starts from."""
        self.restore(self._draws.draw(rng))
        return self._situation.copy()

    def restore(self, state: Array) -> None:
        """Sets up the situation of a state (d,)."""
        self._state = np.array(state, dtype=np.float64)

    @abstractmethod
    def plan(self, state: Array) -> tuple[Array, TrialResult] | None:
        """A goal (p,) that succeeds in a state (d,), and its result; None where the planner finds none."""

    def demonstrations(self, count: int, rng: np.random.Generator) -> Sequence[Demonstration]:
        """Plans successes for the launcher's next situations; skips those without a plan."""
        found: list[Demonstration] = []
        for _ in range(DRAWS * count):
            if len(found) == count:
                break
            state = self._draws.draw(rng)
            if (plan := self.plan(state)) is not None:
                found.append(Demonstration(state, *plan))
        if len(found) < count:
            raise Invalid(f"{self._spec.name}: {len(found)} of {count} demonstrations found; ask for fewer")
        return found

    @property
    def _situation(self) -> Array:
        if self._state is None:
            raise Invalid("execute needs a situation; call reset first")
        return self._state

    def _stroke(self, goal: Array) -> JointTrajectory:
        """The arm's motion to a goal (p,); raises `RefusedGoal` if there is none."""
        try:
            goal = np.asarray(goal, dtype=np.float64)
        except (TypeError, ValueError):
            raise RefusedGoal("invalid", "the goal is not numeric") from None
        if goal.shape != self._low.shape or not ((goal >= self._low) & (goal <= self._high)).all():
            raise RefusedGoal("invalid", "the goal has another shape, is not finite or is out of bounds")
        try:
            return self._primitive.trajectory(self._home, *self._aim(goal))
        except Infeasible as error:
            raise RefusedGoal("infeasible", error.message) from error

    def _spare_time(self, goal: Array) -> float:
        """Spare time of the stroke to a goal (p,) [s]; negative if it is too short."""
        position, speed, time = self._aim(goal)
        return float(np.clip(spare_time(self._primitive.limits, position - self._home, speed, time), *SPARE_TIMES))


def choice(subject: str, what: str, value: str, known: Iterable[str]) -> str:
    """Returns a known value; raises `Invalid`, which lists the known ones."""
    if value not in known:
        raise Invalid(f"{subject} has no {what} {value!r}; there are {', '.join(known)}")
    return value
