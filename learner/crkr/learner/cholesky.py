"""Cholesky factors, computed and used in slices that let other threads run.

    A  (m, m)  symmetric positive definite, in Fortran order       L  (m, m)  its lower factor, A = L L'
    B  (m, c)  right-hand sides

SciPy's wrappers hold the interpreter's lock during the LAPACK call, half a second at m = 4000, and block all threads of
the process. NumPy's matrix product releases the lock, so nearly all of the work is done by such products and LAPACK
gets one panel at a time. Up to `WHOLE` rows one call is short enough, and a little faster.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from scipy.linalg import blas, lapack

from crkr.protocol import Array

__all__ = ["WHOLE", "factor", "solve", "solve_lower"]

WHOLE: Final = 1024  # rows that one call of LAPACK factors: some 8 ms
_PANEL: Final = 256
_ROWS: Final = 1024  # below a panel's corner that are solved for together


def factor(A: Array) -> tuple[Array, int]:
    """Overwrites A with its lower factor, zeros above; also returns 0, or the order of a minor that is not positive."""
    if len(A) <= WHOLE:
        return _corner(A)
    for start, stop in _panels(len(A)):
        if start:
            A[start:, start:stop] -= A[start:, :start] @ A[start:stop, :start].T
        corner, failed = _corner(A[start:stop, start:stop].copy(order="F"))
        if failed:
            return A, start + failed
        A[start:stop, start:stop] = corner
        for top in range(stop, len(A), _ROWS):
            below = A[top : top + _ROWS, start:stop]
            below[:] = blas.dtrsm(1.0, corner, below, side=1, lower=1, trans_a=1)
        A[:start, start:stop] = 0.0
    return A, 0


def solve_lower(L: Array, B: Array) -> Array:
    """L^-1 B, in Fortran order; overwrites B if it has that order."""
    if len(L) <= WHOLE:
        return np.asarray(blas.dtrsm(1.0, L, B, lower=1, overwrite_b=1))
    X = np.asfortranarray(B)
    for start, stop in _panels(len(L)):
        if start:
            X[start:stop] -= L[start:stop, :start] @ X[:start]
        X[start:stop] = blas.dtrsm(1.0, L[start:stop, start:stop], X[start:stop], lower=1)
    return X


def solve(L: Array, B: Array) -> Array:
    """A^-1 B."""
    if len(L) <= WHOLE:
        solved, _ = lapack.dpotrs(L, B, lower=1)
        return np.asarray(solved)
    X = solve_lower(L, np.array(B, order="F"))
    for start, stop in reversed(list(_panels(len(L)))):
        if stop < len(L):
            X[start:stop] -= L[stop:, start:stop].T @ X[stop:]
        X[start:stop] = blas.dtrsm(1.0, L[start:stop, start:stop], X[start:stop], lower=1, trans_a=1)
    return X


def _corner(A: Array) -> tuple[Array, int]:
    """By LAPACK; some implementations accept NaN."""
    L, failed = lapack.dpotrf(A, lower=1, clean=1, overwrite_a=1)
    pivots = L.diagonal()
    if not failed and not math.isfinite(pivots.sum()):
        failed = 1 + int(np.isfinite(pivots).argmin())
    return L, int(failed)


def _panels(count: int) -> Iterator[tuple[int, int]]:
    for start in range(0, count, _PANEL):
        yield start, min(start + _PANEL, count)
