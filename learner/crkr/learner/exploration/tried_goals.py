"""The tried goal that should miss least in another state.

A regression averages successes. Where quite different goals succeed, their mean may miss by far, though it looks
certain; then a correction had better start from a goal that was tried.

    z  (b, d)  states in the metric      slopes  (b, m, d)  by which outcomes change with the state
"""

from __future__ import annotations

from typing import Final

import numpy as np

from crkr.learner.exploration.outcome_index import ObservedTrials
from crkr.learner.exploration.outcome_model import OutcomeModel
from crkr.learner.exploration.outcome_posterior import OutcomeLine
from crkr.learner.exploration.outcome_scales import GOAL_SHARE
from crkr.learner.kernel import squared_distances
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["better_starts", "least_missing"]

_MISSING: Final = 9.0  # squared tolerances expected of a mean, above which a tried goal may be a better start
_LOOKED_AT: Final = 2048  # newest trials, if slopes are known: an answer looks through them each time
_UNSEEN: Final = 400.0  # squared tolerances assumed for an entry that was not observed
_FAR: Final = 1e4  # largest squared tolerances of an entry
_UNKNOWN_SLOPE: Final = 30.0  # squared tolerances added for each squared step of the state
_KNOWN_SLOPE: Final = 3.0  # the same if the outcome is shifted by its slope


def least_missing(
    trials: ObservedTrials, entries: Indices, one_sided: Array | None, z: Array, slopes: Array | None = None
) -> tuple[Array, Array]:
    """Goals (b, p) that should miss least at states z, scaled, and (b,) the squared tolerances they should miss by.

    A trial counts by its squared outcome, by how far its state is, and against it by what was not observed.

    Args:
        trials: At least one.
        entries: (m,) outcome entries that count.
        one_sided: (m,) +1 or -1 for entries that may exceed or fall short of their target, else 0; None: all are 0.
        z: (b, d) states in the metric.
        slopes: (b, m, d) of the outcomes, in tolerances for each step of the state; None: unknown.
    """
    d = z.shape[1]
    first = 0 if slopes is None else max(0, len(trials) - _LOOKED_AT)
    X, o, cost = trials.X[first:], trials.Y[None, first:, entries], _UNKNOWN_SLOPE
    if slopes is not None:
        o, cost = o + (z[:, None] - X[:, :d]) @ slopes.swapaxes(1, 2), _KNOWN_SLOPE
    o = o if one_sided is None else np.where(one_sided * o > 0, 0.0, o)
    off = np.where(np.isnan(o), _UNSEEN, np.minimum(o * o, _FAR)).sum(axis=2) + _FAR * trials.refused[first:]
    off = off + cost * squared_distances(z, X[:, :d])
    best = off.argmin(axis=1)
    return X[best, d:] / GOAL_SHARE, off[np.arange(len(best)), best]


def better_starts(trials: ObservedTrials, model: OutcomeModel, line: OutcomeLine, z: Array) -> tuple[Indices, Array]:
    """States (a,) whose mean should miss by far, and for each a tried goal (a, p), scaled, that should miss by less.

    Args:
        trials: What was tried.
        model: Outcomes near the means.
        line: Its outcomes at the means.
        z: (b, d) states in the metric.
    """
    missed = (line.o**2 + line.R - 1.0)[:, : len(model.entries)].sum(axis=1)
    lost = np.flatnonzero(missed > _MISSING)
    if not len(lost) or not len(trials):
        return lost[:0], line.where[:0]
    slopes = model.of(lost).state_slope()
    goals, off = least_missing(trials.newest(), model.entries, model.one_sided, z[lost], slopes)
    better = off < missed[lost]
    return lost[better], goals[better]
