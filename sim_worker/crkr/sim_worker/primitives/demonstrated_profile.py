"""The acceleration profile of a demonstrated swing, in a form that fits every hit time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from crkr.protocol.checks import finite_array, number
from crkr.protocol.errors import Invalid

__all__ = ["demonstrated_profile"]

Floats = NDArray[np.float64]

_SMOOTHING = 1e-6  # weight of squared differences: bridges gaps between samples, changes a dense recording by < 1e-4


def demonstrated_profile(
    time: Floats, position: Floats, hit_time: float, *, intervals: int = 45, hit_interval: int = 25
) -> Floats:
    """Least-squares accelerations, constant on each interval, that reproduce a recorded motion [Cardoso2015].

    The motion is taken to start at rest with its first sample and to be at rest after the last interval; what was not
    recorded of the follow-through becomes a smooth braking, and what was recorded later is ignored.

    Args:
        time: (m,) strictly increasing times from the start of the swing [s].
        position: (m, n) recorded joint positions [rad].
        hit_time: When the demonstration hit [s]; the recording must reach it.
        intervals: N, intervals of the profile.
        hit_interval: Knot of the hit.

    Returns:
        (N, n) accelerations in units of the hit time [rad / hit_time^2], read-only.

    Raises:
        Invalid: A shape or value that is not a recording of the swing up to the hit.
    """
    time = finite_array(time, "time", (None,))
    position = finite_array(position, "position", (time.size, None))
    hit_time = number(hit_time, "hit_time", above=0.0)
    if time.size < 3 or time[0] < 0 or (np.diff(time) <= 0).any() or time[-1] < hit_time:
        raise Invalid(
            "time must hold at least three strictly increasing values from the swing's start to its hit or later",
            details={"field": "time"},
        )
    knots = time * (hit_interval / hit_time)
    recorded = knots <= intervals
    since = knots[recorded, None] - np.arange(intervals)  # (m', N), in intervals since each began
    travel = np.where(since < 1, 0.5 * np.maximum(since, 0.0) ** 2, since - 0.5)
    smooth = np.sqrt(_SMOOTHING) * np.diff(np.eye(intervals), axis=0)
    rest = np.ones((1, intervals))
    rows = np.vstack([travel, smooth, rest])
    way = position[recorded] - position[0]
    scaled, *_ = np.linalg.lstsq(rows, np.vstack([way, np.zeros((intervals, position.shape[1]))]), rcond=None)
    profile: Floats = scaled * hit_interval**2
    profile.setflags(write=False)
    return profile
