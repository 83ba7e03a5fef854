"""Clarabel for one joint's swing: the only module that calls it."""

from __future__ import annotations

import logging
from enum import Enum
from typing import Any, final

import clarabel
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from crkr.sim_worker.primitives.stroke_program import SwingProgram

__all__ = ["InteriorPoint", "Unsolved"]

Floats = NDArray[np.float64]

_log = logging.getLogger(__name__)

_TOLERANCE = 1e-10  # of feasibility and gap, in units of the acceleration limit: 1e-8 left 1e-6 rad/s^2
_INFEASIBLE = (clarabel.SolverStatus.PrimalInfeasible, clarabel.SolverStatus.AlmostPrimalInfeasible)


class Unsolved(Enum):
    """Why there is no solution."""

    INFEASIBLE = "infeasible"  # proved: no motion satisfies equalities and limits
    FAILED = "failed"  # the solver gave up or panicked


@final
class InteriorPoint:
    """The program in the sparse variables (w, p), set up once; each joint and goal changes only vectors.

    With u_j = w_{j+1} - w_j eliminated the variables are w_1..w_N, p_1..p_N, and all matrices are banded. They are
    constant, so Clarabel's data update replaces the set-up. One object serves one thread.

    Args:
        program: The swing's matrices.
    """

    def __init__(self, program: SwingProgram) -> None:
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
        self._gradient: Floats = difference.T @ program.hessian  # (N, N): u_d to minus the linear cost of w
        self._cost = scipy.sparse.csc_matrix(np.triu(cost))
        self._rows = scipy.sparse.csc_matrix(np.vstack([dynamics, targets, limited, -limited]))
        self._fixed = size + 3
        self._limits = limited.shape[0]
        self._size = size
        self._solver: Any = None

    def solve(
        self, demonstrated: Floats, targets: Floats, lower: Floats, upper: Floats, unit: float
    ) -> Floats | Unsolved:
        """The optimum of one joint.

        Args:
            demonstrated: (N,) u_d [rad].
            targets: (3,) t [rad].
            lower: (4N,) least values of C u [rad].
            upper: (4N,) greatest values [rad].
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
        except BaseException:  # a Rust panic derives from BaseException; the solver that panicked is not used again
            _log.warning("Clarabel failed on a swing; the goal is refused", exc_info=True)
            self._solver = None
            return Unsolved.FAILED
        if status in _INFEASIBLE:
            return Unsolved.INFEASIBLE
        velocity = np.asarray(variables[: self._size], dtype=np.float64)
        if status != clarabel.SolverStatus.Solved or not np.isfinite(velocity).all():
            return Unsolved.FAILED
        return np.diff(velocity, prepend=0.0) * unit

    def _call(self, linear: Floats, right: Floats) -> tuple[Any, Any]:
        if self._solver is None:
            # Clarabel scales the cost by its first data; the same ones each time make answers independent of history.
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
