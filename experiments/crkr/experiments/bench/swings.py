"""The swing's cost beside Clarabel alone, on the same goals in one run."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.primitives.stroke import Infeasible, JointLimits, Primitive

__all__ = ["PrimitiveBench", "SwingGoal", "bench_primitive", "draw_goals"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SwingGoal:
    """Arguments of one `Primitive.trajectory` call.

    Attributes:
        start: (n,) joint positions at rest [rad].
        position: (n,) joint positions at the hit [rad].
        velocity: (n,) joint velocities at the hit [rad/s].
        hit_time: Time of the hit [s].
    """

    start: Floats
    position: Floats
    velocity: Floats
    hit_time: float


@dataclass(frozen=True, slots=True)
class PrimitiveBench:
    """What the comparison measured.

    Attributes:
        ratio: Mean processor time of a swing over that of Clarabel alone.
        primitive_ms: Mean processor time of a swing, all joints [ms].
        clarabel_ms: The same with Clarabel for every joint [ms].
        goals: How many goals were timed.
        infeasible: How many of them were refused, by both.
        disagreements: How many goals one of the two refused and the other did not.
        difference: Greatest difference of the positions at the knots [rad].
    """

    ratio: float
    primitive_ms: float
    clarabel_ms: float
    goals: int
    infeasible: int
    disagreements: int
    difference: float


def bench_primitive(limits: JointLimits, goals: Sequence[SwingGoal], profile: Floats | None = None) -> PrimitiveBench:
    """Times both ways alternately, goal by goal, after one untimed goal each.

    Args:
        limits: The arm's joint limits.
        goals: At least one goal, as drawn in training.
        profile: (N, n) demonstrated profile, or None.
    """
    ways = (Primitive(limits, profile), Primitive(limits, profile, shortcuts=False))
    spent = np.zeros(2)
    infeasible = disagreements = 0
    difference = 0.0
    for way in ways:
        _timed(way, goals[0])
    for goal in goals:
        (first, first_s), (second, second_s) = (_timed(way, goal) for way in ways)
        spent += (first_s, second_s)
        infeasible += first is None and second is None
        disagreements += (first is None) != (second is None)
        if first is not None and second is not None:
            difference = max(difference, float(np.abs(first - second).max()))
    mean_ms = 1e3 * spent / len(goals)
    return PrimitiveBench(
        ratio=float(spent[0] / spent[1]),
        primitive_ms=float(mean_ms[0]),
        clarabel_ms=float(mean_ms[1]),
        goals=len(goals),
        infeasible=infeasible,
        disagreements=disagreements,
        difference=difference,
    )


def _timed(primitive: Primitive, goal: SwingGoal) -> tuple[Floats | None, float]:
    begin = time.process_time()
    try:
        swing = primitive.trajectory(goal.start, goal.position, goal.velocity, goal.hit_time)
        position: Floats | None = swing.position
    except Infeasible:
        position = None
    return position, time.process_time() - begin


def draw_goals(limits: JointLimits, rng: np.random.Generator, count: int) -> list[SwingGoal]:
    """Random goals about as demanding as those of training: a limit binds on some 8 % of the joints.

    For use where no goals of a planner or learner are at hand: ways in proportion to what half the greatest speed
    covers until a hit after 0.5 to 0.7 s, velocities in proportion to the speed limits, and a start at mid-range.
    """
    start = 0.5 * (limits.lower + limits.upper)
    goals = []
    for _ in range(count):
        hit_time = float(rng.uniform(0.5, 0.7))
        way = rng.normal(size=start.size) * 0.3 * limits.speed * hit_time
        velocity = rng.normal(size=start.size) * 0.4 * limits.speed
        goals.append(
            SwingGoal(
                start=start,
                position=np.clip(start + way, limits.lower, limits.upper),
                velocity=np.clip(velocity, -limits.speed, limits.speed),
                hit_time=hit_time,
            )
        )
    return goals
