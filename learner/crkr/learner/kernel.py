"""The covariance of good goals between states.

    s  (d,)     a state, in its own units          Z  (n, d)  standardised states, z = (s - centre) / lengthscales
    k  (m,)     one row of the kernel              K  (a, b)  kernel matrix

Methods take standardised states.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, final

import numpy as np
from scipy.spatial.distance import cdist

from crkr.protocol import Array

__all__ = ["Kernel", "squared_distances"]

# Beyond any sensor's range; squares and products stay finite.
_FARTHEST: Final = 1e50
_LONGEST: Final = 1e250  # length-scales whose product with it is finite


def squared_distances(A: Array, B: Array, out: Array | None = None) -> Array:
    """Squared Euclidean distances, (a, d) and (b, d) to (a, b), written into `out` where given.

    Each entry sums over dimensions in order, so its bits do not depend on the other rows; the selection relies on that
    where distances tie.
    """
    distances: Array = cdist(A, B, "sqeuclidean", out=out)
    return distances


@final
@dataclass(frozen=True, slots=True)
class Kernel:
    """Squared-exponential kernel with a length-scale a dimension [Cardoso2017, eq. 5], and an optional linear term.

    k(s, s') = signal_variance exp(-|z - z'|^2 / 2) + linear_weight z.z', with z = (s - centre) / lengthscales. Equal
    length-scales give [Cardoso2017, eq. 4]. Methods take standardised states.

    Attributes:
        centre: (d,) origin of the standardised states [units of the state].
        lengthscales: (d,) distances over which goals change [units of the state].
        signal_variance: Variance of a scaled goal before any sample.
        linear_weight: Weight of the linear term; 0 is the paper's kernel.
    """

    centre: Array
    lengthscales: Array
    signal_variance: float
    linear_weight: float = 0.0
    _low: Array = field(init=False, repr=False)
    _high: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("centre", "lengthscales"):
            copy = np.array(getattr(self, name), dtype=np.float64)
            copy.setflags(write=False)
            object.__setattr__(self, name, copy)
        farthest = _FARTHEST * np.minimum(self.lengthscales, _LONGEST)
        object.__setattr__(self, "_high", farthest)
        object.__setattr__(self, "_low", -farthest)

    def standardise(self, states: Array) -> Array:
        """Standardises states (..., d) for the other methods; always finite."""
        return np.minimum(np.maximum(states - self.centre, self._low), self._high) / self.lengthscales

    def matrix(self, A: Array, B: Array, out: Array | None = None) -> Array:
        """Kernel matrix (a, b) between standardised states (a, d) and (b, d), written into `out` where given."""
        K = squared_distances(A, B, out)
        K *= -0.5
        np.exp(K, out=K)
        if self.signal_variance != 1.0:
            K *= self.signal_variance
        if self.linear_weight:
            K += self.linear_weight * (A @ B.T)
        return K

    def variance(self, Z: Array) -> Array:
        """Diagonal (n,) of the kernel matrix of standardised states (n, d)."""
        prior = np.full(len(Z), self.signal_variance)
        if self.linear_weight:
            prior += self.linear_weight * np.einsum("ij,ij->i", Z, Z)
        return prior
