"""A global Gaussian process for each entry of the outcome, with the rest of a forward model."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any, Final, final

import numpy as np
from scipy.optimize import minimize
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

from crkr.experiments.rivals.forward_models import REFIT, ForwardModel, SurfaceFit
from crkr.protocol import Array, TaskSpec

__all__ = ["global_gp"]

NOISE: Final = 0.1  # [tolerances], and as a share of the distance from the target
EVIDENCE: Final = 300  # most trials for the fit of a kernel, which takes cubic time
STEPS: Final = 30


def _descend(objective: Any, start: Array, bounds: Array) -> tuple[Array, float]:
    """The search for a kernel's parameters, without scikit-learn's warning of an early end."""
    found = minimize(objective, start, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": STEPS})
    return found.x, float(found.fun)


@final
class _GaussianProcesses:
    """Refitted after each fiftieth more trials; kernels by their evidence after each doubling."""

    def __init__(self, entries: int, size: int) -> None:
        del size  # Unused.
        # A quadratic plus a squared exponential of x (n,), with weight 0.1 at first.
        start = ConstantKernel(1.0, (1e-4, 1e4)) * RBF(3.0, (0.5, 100.0))
        start += ConstantKernel(1.0, (1e-4, 1e4)) * DotProduct(1.0, (1e-2, 1e2)) ** 2 + WhiteKernel(0.01, (1e-4, 10.0))
        self._kernels = [start] * entries
        self._x: list[Array] = []
        self._y: list[Array] = []
        self._searched, self._known = 0, 0
        self._fitted: list[GaussianProcessRegressor | None] = [None] * entries

    def add(self, x: Array, y: Array) -> None:
        self._x.append(x)
        self._y.append(y)

    def fit(self) -> SurfaceFit:
        if len(self._x) >= REFIT * self._known:
            self._known = len(self._x)
            search = self._known >= 2 * self._searched
            self._searched = self._known if search else self._searched
            x, y = np.array(self._x), np.array(self._y)
            for entry in range(y.shape[1]):
                self._fit_entry(entry, x, y[:, entry], search=search)
        return self._outcomes

    def _fit_entry(self, entry: int, x: Array, y: Array, *, search: bool) -> None:
        seen = np.flatnonzero(np.isfinite(y))
        if not len(seen):
            return
        noise = NOISE**2 * (1 + y**2)
        if search:
            few = seen[:: -(-len(seen) // EVIDENCE)]
            model = GaussianProcessRegressor(self._kernels[entry], alpha=noise[few], optimizer=_descend)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # parameters may be at their bounds
                self._kernels[entry] = model.fit(x[few], y[few]).kernel_
        model = GaussianProcessRegressor(self._kernels[entry], alpha=noise[seen], optimizer=None)
        self._fitted[entry] = model.fit(x[seen], y[seen])

    def _outcomes(self, x: Array) -> tuple[Array, Array]:
        """Means (b, q) and their slopes (b, q, n), which scikit-learn does not give."""
        means = np.zeros((len(x), len(self._fitted)))
        slopes = np.zeros((*means.shape, x.shape[1]))
        for entry, model in enumerate(self._fitted):
            if model is None:
                continue
            known, dual = model.X_train_, model.alpha_
            signal, length, quadratic, offset, _ = np.exp(model.kernel_.theta)
            squares = (x**2).sum(1)[:, None] + (known**2).sum(1) - 2 * x @ known.T
            near = signal * np.exp(-0.5 * squares / length**2) * dual  # (b, trials)
            product = offset**2 + x @ known.T
            means[:, entry] = near.sum(1) + quadratic * product**2 @ dual
            slopes[:, entry] = (near @ known - near.sum(1)[:, None] * x) / length**2
            slopes[:, entry] += 2 * quadratic * (product * dual) @ known
        return means, slopes


def global_gp(spec: TaskSpec, seed: int) -> ForwardModel:
    """A Gaussian process over all trials for each entry, quadratic plus squared-exponential, by scikit-learn."""
    return ForwardModel(spec, seed, partial(_GaussianProcesses), noise=0.0, trust=4.0)
