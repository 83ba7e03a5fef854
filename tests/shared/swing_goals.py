"""Strokes that tests of the primitive look at: one of six joints, and goals about as demanding as those of training."""

from typing import NamedTuple

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.primitives.stroke import JointLimits

HOME = np.array([0.0, -1.5, 1.8, -0.3, 1.5, 0.0])
WAY = np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.15])
SPEED = np.array([0.5, -0.4, 0.8, -0.6, 0.7, 0.9])
ARM = JointLimits(np.full(6, -3.0), np.full(6, 3.0), np.full(6, 2.5), np.full(6, 25.0))


def wave(amplitude: float, joints: int = 6) -> Array:
    """A profile (45, n) unlike any other."""
    return amplitude * np.sin(np.linspace(0.0, 6.0, 45)[:, None] + np.arange(joints))


class SwingGoal(NamedTuple):
    """Arguments of `Primitive.trajectory`."""

    start: Array
    position: Array
    velocity: Array
    hit_time: float


def draw_goals(limits: JointLimits, rng: np.random.Generator, count: int) -> list[SwingGoal]:
    """Random goals from mid-range, with a hit after 0.5 to 0.7 s; a limit binds on some 8 % of the joints."""
    start = 0.5 * (limits.lower + limits.upper)
    goals = []
    for _ in range(count):
        hit_time = float(rng.uniform(0.5, 0.7))
        distance = rng.normal(size=start.size) * 0.3 * limits.speed * hit_time
        velocity = np.clip(rng.normal(size=start.size) * 0.4 * limits.speed, -limits.speed, limits.speed)
        goals.append(SwingGoal(start, np.clip(start + distance, limits.lower, limits.upper), velocity, hit_time))
    return goals
