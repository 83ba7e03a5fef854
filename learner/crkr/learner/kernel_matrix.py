"""The kernel matrix of the active samples, of which one learning step renews only the rows of exchanged samples.

A kernel entry has the same bits whichever entries it is computed beside, so that a matrix put together of kept and new
rows equals one made at once, bit by bit: a model does not depend on the path that led to it. That does not hold for
the matrix product in the linear term, with which everything is computed anew.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from crkr.learner.kernel import Kernel
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["KernelMatrix"]

_SMALLEST: Final = 128  # samples; below, making all entries costs less than finding out which are kept
_LARGEST: Final = 1024  # above, the factor takes nearly all of the time, and the memory counts
_MOST_RUNS: Final = 5  # that are copied block by block


@final
class KernelMatrix:
    """Keeps the last matrix that was asked for, and nothing else: 8 m^2 bytes."""

    def __init__(self) -> None:
        self._kernel: Kernel | None = None
        self._rows: Indices = np.empty(0, dtype=np.int64)
        self._K: Array = np.empty((0, 0))

    def of(self, rows: Indices, kernel: Kernel, Z: Array) -> Array:
        """Kernel matrix (m, m) of samples, the caller's to overwrite; symmetric, and in C order.

        Args:
            rows: (m,) numbers of the samples, ascending; a number stands for the same state for good.
            kernel: The covariance; another object is taken for another kernel.
            Z: (m, d) their standardised states.
        """
        if kernel.linear_weight or not _SMALLEST <= len(rows) <= _LARGEST:
            self._kernel, self._rows, self._K = None, rows[:0], np.empty((0, 0))
            return kernel.matrix(Z, Z)
        K = self._renewed(rows, kernel, Z)
        if self._K.shape == K.shape:
            np.copyto(self._K, K)
        else:
            self._K = K.copy()
        self._kernel, self._rows = kernel, rows
        return K

    def _renewed(self, rows: Indices, kernel: Kernel, Z: Array) -> Array:
        if kernel is not self._kernel:
            return kernel.matrix(Z, Z)
        old = np.searchsorted(self._rows, rows)  # where a kept sample was
        kept = self._rows.take(old, mode="clip") == rows
        now, old = np.flatnonzero(kept), old[kept]
        new = np.flatnonzero(~kept)
        starts = [0, *(np.flatnonzero((np.diff(now) > 1) | (np.diff(old) > 1)) + 1).tolist()]
        if not len(now) or len(starts) + len(new) > _MOST_RUNS:
            return kernel.matrix(Z, Z)
        runs = []
        for start, stop in zip(starts, [*starts[1:], len(now)], strict=True):
            to, source = int(now[start]), int(old[start])
            runs.append((slice(to, to + stop - start), slice(source, source + stop - start)))
        K = np.empty((len(rows), len(rows)))
        for to_rows, from_rows in runs:
            for to_columns, from_columns in runs:
                K[to_rows, to_columns] = self._K[from_rows, from_columns]
        if len(new):
            beside = kernel.matrix(Z[new], Z)
            K[new] = beside
            K[:, new] = beside.T
        return K
