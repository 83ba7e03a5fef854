"""Primal-dual active-set steps: which limits bind, guessed and corrected until the optimality conditions hold.

After M. Hintermüller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a semismooth Newton method", SIAM
Journal on Optimization 13, 2002. The optimum without limits moves by -W m when the limits in the set A are held with
multipliers m, and the limited quantities by -G m; a guess of A therefore costs one solve of size |A|. A fixed point
satisfies the optimality conditions of a convex program and is its solution, so nothing found here is approximate. There
is no promise that a fixed point is reached: where it is not, an interior-point method decides.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from crkr.sim_worker.primitives.stroke_program import SwingProgram

__all__ = ["hold_limits"]

Floats = NDArray[np.float64]

_STEPS = 12  # of those that settle, almost all need fewer than eight
_SLACK = 1e-9  # of a limit's width: rounding is not a violation


def hold_limits(program: SwingProgram, free: Floats, lower: Floats, upper: Floats) -> Floats | None:
    """The optimum of one joint within its limits, or None where the steps do not settle.

    Args:
        program: The swing's matrices.
        free: (N,) u, the optimum without limits [rad].
        lower: (4N,) least values of the limited quantities C u [rad].
        upper: (4N,) greatest values [rad].

    Returns:
        u (N,) [rad], or None.
    """
    slack = _SLACK * (upper - lower)
    start = program.limited @ free
    values, multipliers = start, np.zeros_like(start)
    above = below = np.zeros(start.size, dtype=np.bool_)
    for _ in range(_STEPS):
        now_above = (values > upper + slack) | (above & (multipliers > 0))
        now_below = (values < lower - slack) | (below & (multipliers < 0))
        if np.array_equal(now_above, above) and np.array_equal(now_below, below):
            return free - program.release @ multipliers
        above, below = now_above, now_below
        active = np.flatnonzero(above | below)
        if active.size > program.intervals - len(program.equalities):
            return None  # more limits than free directions
        excess = start[active] - np.where(above, upper, lower)[active]
        _, held, dependent = dposv(program.coupling[np.ix_(active, active)], excess)
        if dependent:
            return None
        multipliers = np.zeros_like(start)
        multipliers[active] = held
        values = start - program.coupling[:, active] @ held
    return None
