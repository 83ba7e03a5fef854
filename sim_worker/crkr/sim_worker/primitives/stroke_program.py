"""The quadratic program of one joint's swing, in units of time in which all of its matrices are constant.

After the dynamic movement imitation of [Cardoso2015]: follow the demonstrated acceleration profile while the joint
meets the goal's position and velocity at the hit. With knots h apart and N intervals of constant acceleration a_i:

    u (N,)       accelerations scaled by h^2 [rad];  u_d demonstrated ones;  e = u - u_d
    w_j          velocity at knot j scaled by h [rad]:   w_{j+1} = w_j + u_j,            w_0 = 0
    p_j          way travelled at knot j [rad]:          p_{j+1} = p_j + w_j + u_j / 2,  p_0 = 0
    D (N-1, N)   first differences
    H (N, N)     I + smoothness D^T D: the cost is e^T H e
    E (3, N)     equalities E u = t: p at the hit, w at the hit, w at the end;  t (3,) their targets
    C (4N, N)    limited quantities C u: N rows each of u, w_{j+1}, p_{j+1} and p_j + w_j / 2

A velocity that is linear between knots is extreme at a knot. A position is quadratic, so it stays inside the hull of
p_j, p_j + w_j / 2 and p_{j+1} (its Bernstein polygon): limiting these is sufficient between the knots too, and asks
for at most max|u| / 8 more room than the exact extremum. Smoothness acts on the deviation e, not on u, so that the
demonstration's own goal gives back the demonstrated motion.
"""

from __future__ import annotations

from typing import final

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

__all__ = ["SwingProgram"]

Floats = NDArray[np.float64]


@final
class SwingProgram:
    """The constant matrices, factored once.

    Attributes:
        hessian: H (N, N).
        equalities: E (3, N).
        limited: C (4N, N).
        spread: K (N, 3): the cheapest change of u that changes E u by one unit of each target.
        release: W (N, 4N) = Z C^T, where Z is H^-1 restricted to changes of u that keep E u.
        coupling: G (4N, 4N) = C Z C^T: how enforcing one limit moves the limited quantities.

    Args:
        intervals: N.
        hit_interval: Knot of the hit, in 1..N-1.
        smoothness: Weight of the squared differences of the deviation.
    """

    def __init__(self, intervals: int, hit_interval: int, smoothness: float) -> None:
        identity = np.eye(intervals)
        velocity = np.tril(np.ones((intervals, intervals)))
        ahead = np.arange(intervals)[:, None] - np.arange(intervals)[None, :]  # j - i
        position = np.where(ahead >= 0, ahead + 0.5, 0.0)
        polygon = np.vstack([np.zeros(intervals), (position + 0.5 * velocity)[:-1]])
        difference = np.diff(identity, axis=0)

        self.intervals = intervals
        self.hit_interval = hit_interval
        self.hessian: Floats = identity + smoothness * difference.T @ difference
        self.equalities: Floats = np.vstack([position[hit_interval - 1], velocity[hit_interval - 1], velocity[-1]])
        self.limited: Floats = np.vstack([identity, velocity, position, polygon])

        factor = scipy.linalg.cho_factor(self.hessian)
        towards = scipy.linalg.cho_solve(factor, self.equalities.T)  # H^-1 E^T
        self.spread: Floats = scipy.linalg.solve(self.equalities @ towards, towards.T, assume_a="pos").T
        inward = scipy.linalg.cho_solve(factor, self.limited.T)  # H^-1 C^T
        self.release: Floats = inward - self.spread @ (self.equalities @ inward)
        coupling = self.limited @ self.release
        self.coupling: Floats = 0.5 * (coupling + coupling.T)

    def unlimited(self, demonstrated: Floats, targets: Floats) -> Floats:
        """The optimum for every joint where no limit binds: u = u_d + K (t - E u_d).

        Args:
            demonstrated: (N, n) u_d [rad].
            targets: (3, n) t [rad].

        Returns:
            u (N, n) [rad].
        """
        return demonstrated + self.spread @ (targets - self.equalities @ demonstrated)
