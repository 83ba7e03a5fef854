"""Why the model answers as it does in one state."""

from __future__ import annotations

from typing import Final

import numpy as np

from crkr.learner.kernel import squared_distances
from crkr.learner.model import Model
from crkr.protocol import Explanation, Neighbour, NoSamples, SampleExplanation
from crkr.protocol.checks import finite_array

__all__ = ["explain"]

_NEIGHBOURS: Final = 10


def explain(model: Model, state: object, sample: SampleExplanation | None = None) -> Explanation:
    """The active samples that weigh most in the mean at a state, and its novelty.

    Args:
        model: The policy asked.
        state: (d,) [units of the state].
        sample: Where one more sample stands, passed on.

    Raises:
        Invalid: The state has another shape or is not finite.
        NoSamples: No sample is active.
    """
    kernel, regression = model.parameters.kernel, model.regression
    z = kernel.standardise(finite_array(state, "state", (len(kernel.centre),)))
    if regression is None:
        raise NoSamples(f"task {model.parameters.task!r} has no active sample to explain with")
    weights = regression.influence(z)
    distances = np.sqrt(squared_distances(z[None], regression.Z)[0])
    _, variance, prior = regression.at(z)
    neighbours = tuple(
        Neighbour(model.ids[index], float(weights[index]), float(model.costs[index]), float(distances[index]))
        for index in np.argsort(-np.abs(weights), kind="stable")[:_NEIGHBOURS]
    )
    return Explanation(neighbours, min(variance / prior, 1.0), sample)
