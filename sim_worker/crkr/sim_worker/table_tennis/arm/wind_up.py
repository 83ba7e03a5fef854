"""How a demonstrator swings who draws the paddle back before the stroke, as people do."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["wind_up"]

Floats = NDArray[np.float64]

DEPTH: Final = 4.0  # greatest acceleration, in units of the goal's speed over the hit time


def wind_up(speeds: Floats, hit_time: float, intervals: int = 45, hit_interval: int = 25) -> Floats:
    """Accelerations away from the stroke, then into it: one period of a sine until the hit, nothing after it.

    Args:
        speeds: (n,) goal's joint speeds at the hit [rad/s].
        hit_time: Of the goal [s].
        intervals: N, intervals of the profile.
        hit_interval: Knot of the hit.

    Returns:
        (N, n) accelerations in units of the hit time [rad / hit_time^2], as `Primitive` takes them.
    """
    phase = (np.arange(intervals) + 0.5) / hit_interval
    shape = np.where(phase < 1.0, -DEPTH * np.sin(2 * np.pi * phase), 0.0)
    return np.asarray(np.outer(shape, speeds * hit_time))
