"""Acceleration profiles for a stroke to follow: one taken from a recording, and one with a wind-up.

A profile is (N, n): the accelerations of n joints on N intervals, in units of the hit time [rad / hit_time^2], so that
one profile fits every hit time.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from crkr.protocol import Array
from crkr.protocol.checks import finite_array, number
from crkr.protocol.errors import Invalid

__all__ = ["demonstrated_profile", "wind_up"]

_SMOOTHING: Final = 1e-6  # weight of squared differences: bridges gaps between samples
DEPTH: Final = 4.0  # greatest acceleration of a wind-up, in units of the goal's speed over the hit time


def demonstrated_profile(
    time: Array, position: Array, hit_time: float, *, intervals: int = 45, hit_interval: int = 25
) -> Array:
    """Least-squares accelerations, constant on each interval, that reproduce a recorded motion [Cardoso2015].

    The motion starts at rest with its first sample and is at rest after the last interval. Where the recording ends
    before that, the profile brakes smoothly; later samples are ignored.

    Args:
        time: (m,) strictly increasing times from the start of the stroke [s].
        position: (m, n) recorded joint positions [rad].
        hit_time: Time of the demonstrated hit [s]; the recording must reach it.
        intervals: N, intervals of the profile.
        hit_interval: Knot of the hit.

    Returns:
        (N, n) accelerations in units of the hit time [rad / hit_time^2], read-only.

    Raises:
        Invalid: A shape or value that is not a recording of the stroke up to the hit.
    """
    time = finite_array(time, "time", (None,))
    position = finite_array(position, "position", (time.size, None))
    hit_time = number(hit_time, "hit_time", above=0.0)
    if time.size < 3 or time[0] < 0 or (np.diff(time) <= 0).any() or time[-1] < hit_time:
        raise Invalid(
            "time must hold at least three strictly increasing values from the stroke's start to its hit or later",
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
    profile: Array = scaled * hit_interval**2
    profile.setflags(write=False)
    return profile


def wind_up(speeds: Array, hit_time: float, intervals: int = 45, hit_interval: int = 25) -> Array:
    """Accelerations away from the goal, then towards it: one period of a sine until the hit, zero after it.

    Args:
        speeds: (n,) goal's joint speeds at the hit [rad/s].
        hit_time: Of the goal [s].
        intervals: N, intervals of the profile.
        hit_interval: Knot of the hit.

    Returns:
        (N, n) accelerations in units of the hit time [rad / hit_time^2].
    """
    phase = (np.arange(intervals) + 0.5) / hit_interval
    shape = np.where(phase < 1.0, -DEPTH * np.sin(2 * np.pi * phase), 0.0)
    return np.asarray(np.outer(shape, speeds * hit_time))
