"""Goals that fill the space between the bounds, for a task of which nothing is known yet.

A scrambled Sobol sequence [Joe2008] is cut into groups of `_GROUP` points. Each trial takes a point of the group that
belongs to the number of trials before it, and its id says which: workers that ask at the same moment seldom try the
same goal, and a repeated question gets the same answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final
from uuid import UUID

import numpy as np
from scipy.stats import qmc

from crkr.learner.exploration.draws import uniforms
from crkr.protocol import Array

__all__ = ["space_filling"]

_GROUP: Final = 16
_GROUPS: Final = 2**16  # after which the sequence starts again


def space_filling(seed: int, ids: Sequence[UUID], tried: int, low: Array, high: Array) -> Array:
    """(b, p) goals within the bounds, a function of the task's seed, the trials before, and the trial ids.

    Args:
        seed: The task's.
        ids: One a goal.
        tried: How many trials came before.
        low: (p,) lowest goals allowed.
        high: (p,) highest goals allowed.
    """
    sequence = qmc.Sobol(len(low), scramble=True, seed=np.random.default_rng(seed % 2**64))
    first = _GROUP * (tried % _GROUPS)
    if first:
        sequence.fast_forward(first)
    points = sequence.random(_GROUP * len(ids)).reshape(len(ids), _GROUP, len(low))
    chosen = (uniforms(seed, ids, 1)[:, 0] * _GROUP).astype(int)
    points = points[np.arange(len(ids)), chosen]
    return np.asarray(np.clip(low + points * (high / 2 - low / 2) * 2, low, high))
