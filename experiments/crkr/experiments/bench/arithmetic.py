"""The floor of a prediction: decode, compute, and give the numbers back, in as few library calls as there can be."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crkr.protocol import unpack

__all__ = ["bare_prediction"]


def bare_prediction(samples: int, reply: bytes) -> Callable[[bytes], bytes]:
    """From the payload of a question to as many bytes as `reply`, led by a mean (p,) and standard deviations (p,).

    A kernel row, a product and a triangular solve for m = `samples` samples with d = 6 and p = 13, whose numbers are of
    no account.
    """
    from scipy.linalg import blas  # an extra, and the plain echo does without
    from scipy.spatial.distance import cdist

    rng = np.random.default_rng(0)
    Z, W = rng.normal(size=(samples, 6)), rng.normal(size=(samples, 13))
    L = np.asfortranarray(np.linalg.cholesky(np.exp(-0.5 * cdist(Z, Z, "sqeuclidean")) + np.eye(samples)))

    def compute(payload: bytes) -> bytes:
        z = np.frombuffer(unpack(payload)["states"]["data"])
        k = np.exp(-0.5 * cdist(z[None], Z, "sqeuclidean")[0])
        mean, v = k @ W, blas.dtrsv(L, k, lower=1)
        numbers: bytes = mean.tobytes() + np.sqrt(max(1.0 - v @ v, 0.0) * np.ones(13)).tobytes()
        return numbers + reply[len(numbers) :]

    return compute
