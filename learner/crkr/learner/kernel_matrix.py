"""The kernel matrix of the active samples; a learning step recomputes only the rows of exchanged samples.

A kernel entry's bits do not depend on the other entries, so a matrix of kept and new rows equals one computed at once,
bit by bit, and a model does not depend on its history. The matrix product of a linear term lacks this property; with
one, the whole matrix is recomputed.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np

from crkr.learner.kernel import Kernel
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array

__all__ = ["KernelMatrix"]

_SMALLEST: Final = 128  # samples; with fewer, a full matrix costs less than the search for kept rows
_LARGEST: Final = 1024  # above, the factor takes nearly all of the time, and memory matters
_MOST_RUNS: Final = 5  # rows copied block by block


@final
class KernelMatrix:
    """Keeps the last matrix: 8 m^2 bytes."""

    def __init__(self) -> None:
        self._kernel: Kernel | None = None
        self._rows: Indices = np.empty(0, dtype=np.int64)
        self._K: Array = np.empty((0, 0))

    def of(self, rows: Indices, kernel: Kernel, Z: Array) -> Array:
        """Kernel matrix (m, m) of samples, symmetric and in C order; the caller may overwrite it.

        Args:
            rows: (m,) numbers of the samples, ascending; a number always means the same state.
            kernel: The covariance, compared by identity.
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
        old = np.searchsorted(self._rows, rows)  # previous position of a kept sample
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
