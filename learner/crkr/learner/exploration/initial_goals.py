"""Goals that fill the space between the bounds, for a task of which nothing is known yet.

They follow a scrambled Halton sequence [Owen2017], a point for each trial that came before, moved by a share of the
distance between points that the trial's id decides: workers that ask at the same moment try different goals, and a
repeated question gets the same answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final
from uuid import UUID

import numpy as np

from crkr.learner.exploration.draws import uniforms
from crkr.protocol import Array

__all__ = ["space_filling"]

_MOST: Final = 1024  # trials after which the sequence starts again: going on from far takes time


def space_filling(seed: int, ids: Sequence[UUID], tried: int, low: Array, high: Array) -> Array:
    """(b, p) goals within the bounds, a function of the task's seed, the trials before, and the trial ids.

    Args:
        seed: The task's.
        ids: One a goal.
        tried: How many trials came before.
        low: (p,) lowest goals allowed.
        high: (p,) highest goals allowed.
    """
    from scipy.stats import qmc  # takes longer to load than all else that a server needs; few tasks ask for it

    b, p, first = len(ids), len(low), tried % _MOST
    sequence = qmc.Halton(p, scramble=True, rng=np.random.default_rng(seed % 2**64))
    points = sequence.fast_forward(first).random(b)
    apart = (first + 1 + np.arange(b)) ** (-1.0 / p)
    points = (points + apart[:, None] * (uniforms(seed, ids, p) - 0.5)) % 1.0
    return np.asarray(np.clip(low * (1.0 - points) + high * points, low, high))
