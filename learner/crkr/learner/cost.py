"""The cost of a miss, and the noise variance that a cost gives a sample.

    c  (n,)  costs in [0, 1]           lambda  regularisation, the exploration-exploitation trade-off
    g        cost map                  N  (n,)  noise variances, the diagonal that regularises the kernel matrix

The lower the noise, the closer the regression passes to the sample's goal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from crkr.protocol import Array, Invalid

__all__ = ["noise_variances", "saturated_cost"]

_LARGEST_ODDS_COST: Final = 1.0 - 1e-6


def saturated_cost(error: Array, length: float) -> Array | np.float64:
    """Cost 1 - exp(-|error|^2 / (2 length^2)) in [0, 1]  [Cardoso2017, eq. 8].

    The paper gives its constant as "a^2 = 6 cm"; an area has no such unit, so the length itself is the argument.

    Args:
        error: (..., q) deviation from the target [m].
        length: Distance at which the cost is 0.39, and beyond which it saturates [m], > 0.

    Returns:
        A cost for each error, (...); a number for one error. From about nine lengths on it rounds to 1.0.

    Raises:
        Invalid: The length is not a positive number, or the error is not finite.
    """
    if not (np.isfinite(length) and length > 0):
        raise Invalid(f"length must be a positive number of metres; got {length}")
    deviation = np.asarray(error, dtype=np.float64)
    if not np.isfinite(deviation).all():
        raise Invalid("error must be finite")
    with np.errstate(over="ignore"):  # an overflow means a cost of 1
        cost: Array | np.float64 = -np.expm1(-0.5 * np.sum((deviation / length) ** 2, axis=-1))
    return cost


def _linear(costs: Array) -> Array:
    return costs


def _odds(costs: Array) -> Array:
    clipped = np.minimum(costs, _LARGEST_ODDS_COST)
    return clipped / (1.0 - clipped)


_COST_MAPS: Final[Mapping[str, Callable[[Array], Array]]] = {"linear": _linear, "odds": _odds}


def noise_variances(costs: Array, regularisation: float, cost_map: str, floor: float) -> Array:
    """Noise max(lambda g(c), floor) of each sample, in squared scaled goals.

    The paper's is lambda c [Cardoso2017, alg. 1]; the floor keeps two close samples of cost 0 that disagree from a
    division by almost zero.

    Args:
        costs: (n,) in [0, 1].
        regularisation: lambda > 0.
        cost_map: "linear", g(c) = c, or "odds", g(c) = c / (1 - c), which trusts failures far less.
        floor: Smallest variance, > 0.
    """
    return np.maximum(regularisation * _COST_MAPS[cost_map](costs), floor)
