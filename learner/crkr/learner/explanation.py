"""Explains the model's answer in one state."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from crkr.learner.kernel import squared_distances
from crkr.learner.model import Model
from crkr.learner.samples.history import TrialHistory
from crkr.protocol import Array, Explanation, Grounds, Neighbour, NoSamples, NovelState, SampleExplanation
from crkr.protocol.checks import finite_array

__all__ = ["explain"]

_NEIGHBOURS: Final = 10
_TRIED: Final = 20  # trials near by
_LOOKED_AT: Final = 2000  # newest trials that are searched


def explain(model: Model, history: TrialHistory, state: object, sample: SampleExplanation | None = None) -> Explanation:
    """The grounds of the goal for a state, the active samples with the largest weights in its mean, and its novelty.

    Args:
        model: The policy asked.
        history: The task's trials.
        state: (d,) [units of the state].
        sample: Status of one more sample, passed on.

    Raises:
        Invalid: The state has another shape or is not finite.
        NoSamples: No sample is active, and outcomes do not guide either.
    """
    kernel, regression = model.parameters.kernel, model.regression
    checked = finite_array(state, "state", (len(kernel.centre),))
    z, grounds = kernel.standardise(checked), _grounds(model, history, checked)
    if regression is None:
        if grounds is None:
            raise NoSamples(f"task {model.parameters.task!r} has no active sample to explain with")
        return Explanation((), 1.0, sample, grounds)
    weights = regression.influence(z)
    distances = np.sqrt(squared_distances(z[None], regression.Z)[0])
    _, variance, prior = regression.at(z)
    neighbours = tuple(
        Neighbour(model.ids[index], float(weights[index]), float(model.costs[index]), float(distances[index]))
        for index in np.argsort(-np.abs(weights), kind="stable")[:_NEIGHBOURS]
    )
    return Explanation(neighbours, min(variance / prior, 1.0), sample, grounds)


def _grounds(model: Model, history: TrialHistory, state: Array) -> Grounds | None:
    """What the goal is based on; None without a goal."""
    try:
        answer = model.answer(state, False, [])
    except (NoSamples, NovelState):
        return None
    rows = history.newest_tried(_LOOKED_AT)
    away = model.parameters.kernel.standardise(history.states[rows]) - model.parameters.kernel.standardise(state)
    nearest = rows[np.vecdot(away, away).argsort(kind="stable")[:_TRIED]]
    chance = math.nan if answer.success_probability is None else float(answer.success_probability)
    return Grounds(
        answer.policy,
        model.active,
        None if math.isnan(chance) else chance,
        len(nearest),
        int(history.successes(nearest).sum()),
    )
