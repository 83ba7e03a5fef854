"""Fits the kernel to the active samples by their evidence, the marginal likelihood of their goals.

    X      (m, d)   states about the centre             Y      (m, p)   scaled goals minus prior
    theta  (d + 1)  log length-scales, then log signal variance          Z = X / length-scales
    K      (m, m)   squared-exponential part            Ky     K + linear part + diag(N)
    A      (m, p)   Ky^-1 Y                             N      (m,)     noise variances
    G      (m, m)   A A^T - p Ky^-1: d evidence / d Ky, doubled

The paper prints |K|^(-n/2) in eq. 6 for |K|^(-1/2), and in eq. 7 once K for Ky; both are corrected here. The p outputs
share the kernel, so their log evidences add up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from scipy.linalg import lapack

from crkr.learner.cost import noise_variances
from crkr.learner.kernel import squared_distances
from crkr.learner.model import Model
from crkr.protocol import Array, Invalid, NoSamples, TaskSpec
from crkr.protocol.checks import finite_array, number

__all__ = ["FitProblem", "FitResult", "check_fit", "fit", "log_evidence"]

_LENGTHSCALE_RANGE: Final = (0.05, 20.0)  # times those of the task's creation
_VARIANCE_RANGE: Final = (1e-3, 1e3)
_LOG_NUMBERS: Final = (-690.0, 690.0)  # beyond, exp overflows
_MOST: Final = 1500  # samples in a fit
_FARTHEST: Final = 1e4  # medians, or length-scales, from the centre to a sample
_MAX_ITERATIONS: Final = 60
_UNREACHABLE: Final = 1e25  # stands for an infinite objective, which L-BFGS cannot step back from


@final
@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """Input of a fit; plain data that can be sent to another process.

    Attributes:
        X: (m, d) states about the centre [units of the state].
        Y: (m, p) scaled goals minus their prior mean.
        noise: (m,) lambda g(c), which the fit keeps.
        noise_floor: Smallest noise, relative to the signal variance.
        lengthscales: (d,) at the start [units of the state].
        signal_variance: At the start.
        linear_weight: Weight of the kernel's linear term, which the fit keeps.
        reference: (d,) length-scales of the task's creation; the fit stays within 0.05 to 20 times these.
    """

    X: Array
    Y: Array
    noise: Array
    noise_floor: float
    lengthscales: Array
    signal_variance: float
    linear_weight: float
    reference: Array

    @classmethod
    def of(cls, model: Model, reference: Array) -> FitProblem:
        """The problem of fitting a model's active samples, starting from its own kernel.

        Extreme outliers are left out: they carry no information on length-scales and drown the rest in rounding. More
        than `_MOST` samples are thinned evenly, as a fit of all would take minutes.

        Raises:
            NoSamples: No sample is active.
        """
        own = model.parameters
        if not model.active:
            raise NoSamples(f"task {own.task!r} has no active sample to fit to")
        X = model.states - own.kernel.centre
        away = np.abs(X)
        with np.errstate(over="ignore"):  # a limit beyond all numbers leaves no state out
            near = np.flatnonzero((away <= _FARTHEST * np.maximum(reference, np.median(away, axis=0))).all(axis=1))
        if len(near) > _MOST:
            near = near[np.linspace(0, len(near) - 1, _MOST).astype(np.int64)]
        return cls(
            X=X[near],
            Y=(model.goals[near] - own.prior) / own.scales,
            noise=noise_variances(model.costs[near], own.regularisation, own.cost_map, 0.0),
            noise_floor=own.noise_floor,
            lengthscales=own.kernel.lengthscales,
            signal_variance=own.kernel.signal_variance,
            linear_weight=own.kernel.linear_weight,
            reference=reference,
        )


@final
@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """What a fit found.

    Attributes:
        accepted: The evidence improved, so the numbers below are new.
        lengthscales: (d,) in force after the fit [units of the state].
        signal_variance: In force after the fit.
        before: Log evidence at the start [nats].
        after: Log evidence found; `before` where nothing better was.
    """

    accepted: bool
    lengthscales: Array
    signal_variance: float
    before: float
    after: float


@np.errstate(over="ignore", invalid="ignore")  # the result says so
def log_evidence(problem: FitProblem, theta: Array) -> tuple[float, Array]:
    """Log marginal likelihood and its gradient (d + 1,) with respect to theta  [Cardoso2017, eq. 6 and 7].

    Returns -inf and a zero gradient where the kernel matrix is not numerically positive definite, or evidence or
    gradient overflows.
    """
    lengthscales, variance = np.exp(theta[:-1]), float(np.exp(theta[-1]))
    m, p = problem.Y.shape
    Z = problem.X / lengthscales
    K = squared_distances(Z, Z)
    K *= -0.5
    np.exp(K, out=K)
    K *= variance
    floor = problem.noise_floor * variance
    Ky = K + problem.linear_weight * (Z @ Z.T) if problem.linear_weight else K.copy()
    Ky.flat[:: m + 1] += np.maximum(problem.noise, floor)
    L, failed_pivot = lapack.dpotrf(Ky.T, lower=1, clean=1, overwrite_a=1)
    if failed_pivot:
        return -np.inf, np.zeros_like(theta)
    A, _ = lapack.dpotrs(L, problem.Y, lower=1)
    value = -0.5 * float(np.vdot(problem.Y, A)) - p * (float(np.log(L.diagonal()).sum()) + 0.5 * m * np.log(2 * np.pi))
    inverse, _ = lapack.dpotri(L, lower=1, overwrite_c=1)  # only the trace in eq. 7 needs every entry
    inverse *= p
    G = A @ A.T
    G -= inverse  # the lower triangle, then the upper; both with the diagonal
    G -= inverse.T
    G.flat[:: m + 1] += inverse.diagonal()
    gradient = np.empty_like(theta)
    gradient[:-1] = -problem.linear_weight * np.einsum("ij,ij->j", Z, G @ Z) if problem.linear_weight else 0.0
    at_floor = problem.noise < floor
    gradient[-1] = 0.5 * floor * float(G.diagonal()[at_floor].sum())
    G *= K
    sums = G.sum(axis=1)
    gradient[:-1] += sums @ (Z * Z) - np.einsum("ij,ij->j", Z, G @ Z)
    gradient[-1] += 0.5 * float(sums.sum())
    if not (np.isfinite(value) and np.isfinite(gradient).all()):
        return -np.inf, np.zeros_like(theta)
    return value, gradient


def fit(problem: FitProblem) -> FitResult:
    """Length-scales and signal variance that maximise the evidence locally, by L-BFGS within bounds; lambda stays.

    Deterministic; takes tens of factorisations of an (m, m) matrix.
    """
    from scipy.optimize import minimize  # slow to import; a server fits in another process

    log_reference, log_variance = np.log(problem.reference), np.log(problem.signal_variance)
    low = np.append(log_reference + np.log(_LENGTHSCALE_RANGE[0]), np.log(_VARIANCE_RANGE[0]))
    high = np.append(log_reference + np.log(_LENGTHSCALE_RANGE[1]), np.log(_VARIANCE_RANGE[1]))
    low, high = np.maximum(low, _LOG_NUMBERS[0]), np.minimum(high, _LOG_NUMBERS[1])
    start = np.append(np.log(problem.lengthscales), log_variance)
    at_start = log_evidence(problem, start)
    before = at_start[0]

    def objective(theta: Array) -> tuple[float, Array]:
        value, gradient = at_start if np.array_equal(theta, start) else log_evidence(problem, theta)
        return (-value, -gradient) if np.isfinite(value) else (_UNREACHABLE, gradient)

    options = {"maxiter": _MAX_ITERATIONS, "ftol": 1e-5}
    found = minimize(
        objective,
        np.clip(start, low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)),
        options=options,
    )
    after = -float(found.fun)
    if not after > before:
        return FitResult(False, problem.lengthscales, problem.signal_variance, before, before)
    lengthscales = np.exp(found.x[:-1])
    lengthscales.setflags(write=False)
    return FitResult(True, lengthscales, float(np.exp(found.x[-1])), before, after)


def check_fit(spec: TaskSpec, lengthscales: object, signal_variance: object) -> tuple[Array, float]:
    """Checks the result of a fit against a task's specification, before it is logged.

    Raises:
        Invalid: Numbers that are not finite and positive, or not d of them.
    """
    fitted = finite_array(lengthscales, "lengthscales", (len(spec.state),))
    variance = number(signal_variance, "signal_variance", above=0.0)
    if (fitted <= 0).any():
        raise Invalid(f"lengthscales must be positive; got {fitted.tolist()}")
    return fitted, variance
