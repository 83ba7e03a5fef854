"""The quadratic program of one joint's stroke, and three ways to solve it, fastest first.

A stroke starts at rest, passes the goal's position with the goal's velocity at the hit time, and ends at rest. Among
all such motions the program picks the one that follows a given acceleration profile best [Cardoso2015]. Between N + 1
knots h seconds apart the acceleration a_i is constant. In units of h every matrix below is constant, so that all
factorisations are done once per arm:

    u (N,)       accelerations times h^2 [rad];  u_d those of the profile;  e = u - u_d
    w_j          velocity at knot j times h [rad]:    w_{j+1} = w_j + u_j,            w_0 = 0
    p_j          distance from the start [rad]:       p_{j+1} = p_j + w_j + u_j / 2,  p_0 = 0
    D (N-1, N)   first differences
    H (N, N)     I + smoothness D^T D: the cost is e^T H e
    E (3, N)     equalities E u = t: p at the hit, w at the hit, w at the end;  t (3,) their targets
    C (4N, N)    limited quantities lower <= C u <= upper: N rows each of u, w_{j+1}, p_{j+1} and p_j + w_j / 2

    minimise e^T H e  subject to  E u = t,  lower <= C u <= upper

Limits at the knots hold between them too. Velocity is linear there. Position is quadratic and stays inside the hull of
p_j, p_j + w_j / 2 and p_{j+1} (its Bernstein polygon), which is wider than the motion by at most max|u| / 8.
The cost is on the deviation e rather than on u, so that a demonstration's own goal gives back the demonstrated motion.

1. Without limits the optimum is closed-form: u = u_d + K (t - E u_d), with K = H^-1 E^T (E H^-1 E^T)^-1
   (`StrokeProgram.unlimited`). Most joints of most strokes need no more.
2. Where a limit is crossed, `hold_limits` guesses which limits bind and corrects the guess: a primal-dual active set,
   after M. Hintermüller, K. Ito, K. Kunisch, "The primal-dual active set strategy as a semismooth Newton method", SIAM
   Journal on Optimization 13, 2002. Holding the limits in a set A with multipliers m moves the optimum by -W m and the
   limited quantities by -G m, so a guess costs one solve of size |A|. A guess that repeats itself satisfies the
   optimality conditions of a convex program and is the exact solution. It need not repeat itself.
3. Then an interior-point method, Clarabel, decides (`InteriorPoint`); it also proves that no stroke exists.
"""

from __future__ import annotations

import logging
from enum import Enum
from typing import Any, Final, final

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.linalg.lapack import dposv

from crkr.protocol import Array

__all__ = ["InteriorPoint", "StrokeProgram", "Unsolved", "hold_limits"]

_log = logging.getLogger(__name__)

_STEPS: Final = 12  # of those active sets that settle, almost all need fewer than eight
_SLACK: Final = 1e-9  # of a limit's width: rounding is not a violation
_TOLERANCE: Final = 1e-10  # of feasibility and gap, in units of the acceleration limit: 1e-8 left 1e-6 rad/s^2
_INFEASIBLE: Final = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible)


@final
class StrokeProgram:
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
        self.hessian: Array = identity + smoothness * difference.T @ difference
        self.equalities: Array = np.vstack([position[hit_interval - 1], velocity[hit_interval - 1], velocity[-1]])
        self.limited: Array = np.vstack([identity, velocity, position, polygon])

        factor = scipy.linalg.cho_factor(self.hessian)
        towards = scipy.linalg.cho_solve(factor, self.equalities.T)  # H^-1 E^T
        self.spread: Array = scipy.linalg.solve(self.equalities @ towards, towards.T, assume_a="pos").T
        inward = scipy.linalg.cho_solve(factor, self.limited.T)  # H^-1 C^T
        self.release: Array = inward - self.spread @ (self.equalities @ inward)
        coupling = self.limited @ self.release
        self.coupling: Array = 0.5 * (coupling + coupling.T)

    def unlimited(self, demonstrated: Array, targets: Array) -> Array:
        """The optimum of each of n joints without limits: u = u_d + K (t - E u_d).

        Args:
            demonstrated: (N, n) u_d [rad].
            targets: (3, n) t [rad].

        Returns:
            u (N, n) [rad].
        """
        return demonstrated + self.spread @ (targets - self.equalities @ demonstrated)


def hold_limits(program: StrokeProgram, free: Array, lower: Array, upper: Array) -> Array | None:
    """The optimum of one joint within its limits, or None where the active set does not settle.

    Args:
        program: The stroke's matrices.
        free: (N,) u, the optimum without limits [rad].
        lower: (4N,) least values of C u [rad].
        upper: (4N,) greatest values of C u [rad].

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


class Unsolved(Enum):
    """Why there is no solution."""

    INFEASIBLE = "infeasible"  # proved: no motion satisfies equalities and limits
    FAILED = "failed"  # the solver gave up or panicked


@final
class InteriorPoint:
    """Clarabel on the program in the sparse variables (w, p), set up once; a goal changes only vectors.

    With u_j = w_{j+1} - w_j eliminated the variables are w_1..w_N, p_1..p_N, and all matrices are banded. One object
    serves one thread.
    """

    def __init__(self, program: StrokeProgram) -> None:
        size = program.intervals
        previous = np.eye(size, k=-1)  # w_{j+1} list to w_j list, with w_0 = 0
        difference = np.eye(size) - previous  # w to u
        nothing = np.zeros((size, size))
        hit = np.eye(size)[program.hit_interval - 1]
        end = np.eye(size)[-1]
        dynamics = np.hstack([-0.5 * (np.eye(size) + previous), difference])
        targets = np.vstack([np.r_[0 * hit, hit], np.r_[hit, 0 * hit], np.r_[end, 0 * end]])
        limited = np.vstack(
            [
                np.hstack([difference, nothing]),
                np.hstack([np.eye(size), nothing]),
                np.hstack([nothing, np.eye(size)]),
                np.hstack([0.5 * previous, previous]),
            ]
        )
        cost = np.zeros((2 * size, 2 * size))
        cost[:size, :size] = difference.T @ program.hessian @ difference
        self._gradient: Array = difference.T @ program.hessian  # (N, N): u_d to minus the linear cost of w
        self._cost = scipy.sparse.csc_matrix(np.triu(cost))
        self._rows = scipy.sparse.csc_matrix(np.vstack([dynamics, targets, limited, -limited]))
        self._fixed = size + 3
        self._limits = limited.shape[0]
        self._size = size
        self._solver: Any = None

    def solve(self, demonstrated: Array, targets: Array, lower: Array, upper: Array, unit: float) -> Array | Unsolved:
        """The optimum of one joint.

        Args:
            demonstrated: (N,) u_d [rad].
            targets: (3,) t [rad].
            lower: (4N,) least values of C u [rad].
            upper: (4N,) greatest values of C u [rad].
            unit: Size of a typical u [rad]; the program is solved in this unit so that tolerances mean something.

        Returns:
            u (N,) [rad], or why there is none.
        """
        linear = np.zeros(2 * self._size)
        linear[: self._size] = self._gradient @ demonstrated / -unit
        right = np.zeros(self._fixed + 2 * self._limits)
        right[self._size : self._fixed] = targets / unit
        right[self._fixed : self._fixed + self._limits] = upper / unit
        right[self._fixed + self._limits :] = lower / -unit
        try:
            status, variables = self._call(linear, right)
        except (KeyboardInterrupt, SystemExit, GeneratorExit):
            raise
        except BaseException:  # a Rust panic is a BaseException; that solver is not used again
            _log.warning("Clarabel failed on a stroke; the goal is refused", exc_info=True)
            self._solver = None
            return Unsolved.FAILED
        if status in _INFEASIBLE:
            return Unsolved.INFEASIBLE
        velocity = np.asarray(variables[: self._size], dtype=np.float64)
        if status != clarabel.SolverStatus.Solved or not np.isfinite(velocity).all():
            return Unsolved.FAILED
        return np.diff(velocity, prepend=0.0) * unit

    def _call(self, linear: Array, right: Array) -> tuple[Any, Any]:
        if self._solver is None:
            # Clarabel scales the cost by its first data; fixed first data make answers independent of history.
            cones = [clarabel.ZeroConeT(self._fixed), clarabel.NonnegativeConeT(2 * self._limits)]
            neutral = np.zeros_like(linear), np.ones_like(right)
            self._solver = clarabel.DefaultSolver(self._cost, neutral[0], self._rows, neutral[1], cones, _settings())
        self._solver.update(q=linear, b=right)
        solution = self._solver.solve()
        return solution.status, solution.x


def _settings() -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.presolve_enable = False  # presolving forbids data updates
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = _TOLERANCE
    return settings
