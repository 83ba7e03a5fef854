"""A cost that is quadratic near its target and saturates far away."""

from __future__ import annotations

import numpy as np

from crkr.protocol import Array, Invalid

__all__ = ["saturated_cost"]


def saturated_cost(error: Array, length: float) -> Array | np.float64:
    """Cost 1 - exp(-|error|^2 / (2 length^2)) in [0, 1]  [Cardoso2017, eq. 8].

    The paper gives its constant as "a^2 = 6 cm"; an area has no such unit, so the length itself is the argument.

    Args:
        error: (..., q) deviation from the target [m].
        length: Distance at which the cost is 0.39, and beyond which it saturates [m], > 0.

    Returns:
        A cost for each error, (...); a number for one error. Some nine lengths away it is exactly 1.0, because a float
        cannot tell the difference.

    Raises:
        Invalid: The length is not a positive number, or the error is not finite.
    """
    if not (np.isfinite(length) and length > 0):
        raise Invalid(f"length must be a positive number of metres; got {length}")
    deviation = np.asarray(error, dtype=np.float64)
    if not np.isfinite(deviation).all():
        raise Invalid("error must be finite")
    with np.errstate(over="ignore"):  # infinitely many lengths away is a cost of 1
        cost: Array | np.float64 = -np.expm1(-0.5 * np.sum((deviation / length) ** 2, axis=-1))
    return cost
