"""A stroke of an arm: from rest through the goal's joint positions and velocities at the hit time, and back to rest.

`quadratic_program` states the program that is solved for each joint, and how. `Primitive` checks a goal, solves all
joints, and returns the motion or refuses the goal with a reason that can be reported:

    primitive = Primitive(JointLimits(lower, upper, speed, acceleration))
    motion = primitive.trajectory(start, goal_position, goal_velocity, hit_time)
    position, velocity, acceleration = motion.sample(times)

examples/stroke.py plans one for an arm of two joints. Profiles to follow come from `profiles`.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Array
from crkr.protocol.checks import finite_array, number
from crkr.protocol.errors import CrkrError, Invalid
from crkr.sim_worker.primitives.joint_motion import JointLimits, JointTrajectory
from crkr.sim_worker.primitives.quadratic_program import InteriorPoint, StrokeProgram, Unsolved, hold_limits

__all__ = ["Infeasible", "JointLimits", "JointTrajectory", "Primitive"]

_ACCURACY: Final = 1e-6  # [rad], [rad/s], [rad/s^2]: how well an accepted stroke meets its equalities and limits
_SHORTEST: Final = 1e-3  # hit time [s]
_LONGEST: Final = 60.0


@final
class Infeasible(CrkrError):
    """No stroke meets the goal within the joint limits.

    Attributes:
        reason: "not_finite", "hit_time", "start_position", "goal_position", "goal_velocity", "out_of_reach" (the goal
            cannot be met in time even without position limits), "limits" (no motion keeps all limits) or "solver"
            (no answer was found).
        joint: Index of the joint that fails; None where no single joint does.
    """

    def __init__(self, reason: str, joint: int | None, message: str) -> None:
        where = "" if joint is None else f"joint {joint}: "
        super().__init__(where + message, details={"reason": reason, "joint": joint})
        self.reason = reason
        self.joint = joint


@final
class Primitive:
    """Plans strokes for one arm. One object serves one thread.

    Args:
        limits: The arm's n joints.
        profile: (N, n) demonstrated accelerations in units of the hit time [rad / hit_time^2], as
            `demonstrated_profile` gives them; None is zero, which asks for the smallest accelerations.
        intervals: N, intervals of constant acceleration.
        hit_interval: Knot of the hit; the stroke lasts N / hit_interval times the hit time.
        smoothness: Weight of the squared differences between successive deviations from the profile.
        shortcuts: False solves every joint by Clarabel: slower, the same strokes; for tests and benchmarks.

    Raises:
        Invalid: A profile of another shape, or settings out of range.
    """

    def __init__(
        self,
        limits: JointLimits,
        profile: Array | None = None,
        *,
        intervals: int = 45,
        hit_interval: int = 25,
        smoothness: float = 20.0,
        shortcuts: bool = True,
    ) -> None:
        if not 4 <= hit_interval <= intervals - 4:
            raise Invalid(f"hit_interval must be in 4..{intervals - 4}; got {hit_interval}")
        number(smoothness, "smoothness", low=0.0, high=1e6)
        joints = limits.lower.size
        if profile is None:
            profile = np.zeros((intervals, joints))
        self.limits = limits
        self.profile: Array = finite_array(profile, "profile", (intervals, joints))
        self._demonstrated = self.profile / hit_interval**2  # (N, n) u_d
        self._program = StrokeProgram(intervals, hit_interval, smoothness)
        self._interior_point = InteriorPoint(self._program)
        self._shortcuts = shortcuts

    def trajectory(self, start: Array, goal_position: Array, goal_velocity: Array, hit_time: float) -> JointTrajectory:
        """The stroke that follows the profile best.

        Args:
            start: (n,) joint positions at rest at time 0 [rad].
            goal_position: (n,) joint positions at the hit [rad].
            goal_velocity: (n,) joint velocities at the hit [rad/s].
            hit_time: Time of the hit [s].

        Returns:
            Knots from rest to rest; the hit is knot `hit_interval`. Equalities and limits hold to 1e-6, the limits
            between knots too.

        Raises:
            Infeasible: There is no such stroke; with the reason and the joint. A goal within max|acceleration| h^2 / 8
                (about a milliradian) of a position limit may be refused although a stroke exists.
            Invalid: An array of another shape.
        """
        start, goal_position, goal_velocity = (
            self._vector(start, "start"),
            self._vector(goal_position, "goal_position"),
            self._vector(goal_velocity, "goal_velocity"),
        )
        self._refuse_impossible(start, goal_position, goal_velocity, hit_time)
        step = float(hit_time) / self._program.hit_interval
        targets = np.vstack([goal_position - start, goal_velocity * step, np.zeros_like(start)])  # (3, n)
        lower, upper = self._bounds(start, step)
        if self._shortcuts:
            scaled = self._program.unlimited(self._demonstrated, targets)  # (N, n)
            values = self._program.limited @ scaled  # (4N, n)
            binding = np.flatnonzero(((values > upper) | (values < lower)).any(axis=0))
        else:
            scaled, binding = np.zeros_like(self._demonstrated), np.arange(start.size)
        if binding.size:
            self._refuse_out_of_reach(goal_position - start, goal_velocity, float(hit_time))
        for joint in binding:
            scaled[:, joint] = self._limited(
                int(joint), scaled[:, joint], targets[:, joint], lower[:, joint], upper[:, joint], step
            )
        return self._integrate(start, scaled, step)

    def _vector(self, value: Array, name: str) -> Array:
        array = np.array(value, dtype=np.float64)
        if array.shape != self.limits.lower.shape:
            raise Invalid(f"{name} must have shape {self.limits.lower.shape}; got {array.shape}")
        return array

    def _refuse_impossible(self, start: Array, position: Array, velocity: Array, hit_time: float) -> None:
        limits = self.limits
        for name, value in (("start", start), ("goal_position", position), ("goal_velocity", velocity)):
            _refuse(~np.isfinite(value), "not_finite", f"{name} is not finite")
        if not np.isfinite(hit_time):
            raise Infeasible("not_finite", None, f"hit_time is not finite: {hit_time}")
        if not _SHORTEST <= hit_time <= _LONGEST:
            raise Infeasible("hit_time", None, f"hit_time must be in [{_SHORTEST}, {_LONGEST}] s; got {hit_time}")
        outside = "{} is outside the position limits"
        _refuse((start < limits.lower) | (start > limits.upper), "start_position", outside.format("start"))
        _refuse((position < limits.lower) | (position > limits.upper), "goal_position", outside.format("goal"))
        _refuse(np.abs(velocity) > limits.speed, "goal_velocity", "goal velocity is above the speed limit")

    def _refuse_out_of_reach(self, way: Array, velocity: Array, hit_time: float) -> None:
        """Refuses what full acceleration, cruise and full braking cannot do: necessary, whatever the profile."""
        acceleration, speed = self.limits.acceleration, self.limits.speed
        follow = hit_time * (self._program.intervals / self._program.hit_interval - 1)
        slow = np.abs(velocity) > acceleration * min(hit_time, follow) * (1 + 1e-9)
        _refuse(slow, "out_of_reach", "goal velocity cannot be reached, or braked from, in time")
        for sign in (1.0, -1.0):
            end = sign * velocity
            peak = np.minimum(speed, 0.5 * (acceleration * hit_time + end))
            cruise = hit_time - (2 * peak - end) / acceleration
            farthest = (2 * peak**2 - end**2) / (2 * acceleration) + peak * cruise
            _refuse(
                sign * way > farthest + _ACCURACY,
                "out_of_reach",
                "goal position cannot be reached with the goal velocity in time",
            )

    def _bounds(self, start: Array, step: float) -> tuple[Array, Array]:
        """Least and greatest values (4N, n) of the limited quantities [rad]."""
        limits, rows = self.limits, self._program.intervals
        acceleration, speed = limits.acceleration * step**2, limits.speed * step
        below, above = limits.lower - start, limits.upper - start
        lower = np.repeat(np.vstack([-acceleration, -speed, below, below]), rows, axis=0)
        upper = np.repeat(np.vstack([acceleration, speed, above, above]), rows, axis=0)
        return lower, upper

    def _limited(self, joint: int, free: Array, targets: Array, lower: Array, upper: Array, step: float) -> Array:
        """The optimum (N,) of a joint where a limit binds."""
        if self._shortcuts:
            held = hold_limits(self._program, free, lower, upper)
            if held is not None and self._accurate(held, targets, lower, upper, step):
                return held
        unit = float(self.limits.acceleration[joint]) * step**2
        solved = self._interior_point.solve(self._demonstrated[:, joint], targets, lower, upper, unit)
        if solved is Unsolved.INFEASIBLE:
            raise Infeasible("limits", joint, "no motion meets the goal within all limits")
        if isinstance(solved, Unsolved):
            raise Infeasible("solver", joint, "the solver found neither a motion nor a proof that there is none")
        solved = solved + self._program.spread @ (targets - self._program.equalities @ solved)
        if not self._accurate(solved, targets, lower, upper, step):
            raise Infeasible("solver", joint, f"the solver's motion misses its goal or limits by more than {_ACCURACY}")
        return solved

    def _accurate(self, scaled: Array, targets: Array, lower: Array, upper: Array, step: float) -> bool:
        rows = self._program.intervals
        unit = np.repeat([step**2, step, 1.0, 1.0], rows)  # of each limited quantity, to SI
        values = self._program.limited @ scaled
        beyond = np.maximum(values - upper, lower - values) / unit
        missed = np.abs(self._program.equalities @ scaled - targets) / np.array([1.0, step, step])
        return bool(beyond.max() <= 0.5 * _ACCURACY and missed.max() <= 0.5 * _ACCURACY)

    def _integrate(self, start: Array, scaled: Array, step: float) -> JointTrajectory:
        rows = self._program.intervals
        values = self._program.limited[rows : 3 * rows] @ scaled  # w then p
        rest = np.zeros((1, start.size))
        return JointTrajectory(
            time=step * np.arange(rows + 1, dtype=np.float64),
            position=start + np.vstack([rest, values[rows:]]),
            velocity=np.vstack([rest, values[:rows]]) / step,
            acceleration=scaled / step**2,
        )


def _refuse(wrong: NDArray[np.bool_], reason: str, message: str) -> None:
    if wrong.any():
        raise Infeasible(reason, int(np.argmax(wrong)), message)
