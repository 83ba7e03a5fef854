"""From what a trial cost to how little its goal is trusted.

    c  (n,)  costs in [0, 1]           lambda  regularisation, the exploration-exploitation trade-off
    g        cost map                  N  (n,)  noise variances, the diagonal that regularises the kernel matrix

The lower the noise, the closer the regression passes to the sample's goal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from crkr.protocol import Array

__all__ = ["noise_variances"]

_LARGEST_ODDS_COST: Final = 1.0 - 1e-6


def _linear(costs: Array) -> Array:
    return costs


def _odds(costs: Array) -> Array:
    clipped = np.minimum(costs, _LARGEST_ODDS_COST)
    return clipped / (1.0 - clipped)


_COST_MAPS: Final[Mapping[str, Callable[[Array], Array]]] = {"linear": _linear, "odds": _odds}


def noise_variances(costs: Array, regularisation: float, cost_map: str, floor: float) -> Array:
    """Noise max(lambda g(c), floor) of each sample, in squared scaled goals.

    The paper's is lambda c [Cardoso2017, alg. 1]; a cost of 0 would make two near samples that disagree divide by
    nearly nothing, hence the floor.

    Args:
        costs: (n,) in [0, 1].
        regularisation: lambda > 0.
        cost_map: "linear", g(c) = c, or "odds", g(c) = c / (1 - c), which trusts failures far less.
        floor: Smallest variance, > 0.
    """
    return np.maximum(regularisation * _COST_MAPS[cost_map](costs), floor)
