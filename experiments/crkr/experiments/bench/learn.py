"""What `crkr bench learn` measures: the learner beside scikit-learn and beside the bare matrix operations.

Both sides of a ratio take turns and are timed by the thread's own clock, so that other load matters little. `crkr` has
numpy use one BLAS thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from time import thread_time
from typing import Final
from uuid import UUID

import numpy as np
from scipy.linalg import blas, lapack
from scipy.spatial.distance import cdist
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from crkr.experiments.bench.growth import resident
from crkr.experiments.bench.guided import measure_guided
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, ratio
from crkr.experiments.bench.workload import BUDGET, D, P, bench_spec
from crkr.learner import Anms, FitProblem, Learner, Model, Regression, fit
from crkr.protocol import Array, Trial

__all__ = ["measure"]

_PAGE: Final = 10_000  # trials that are learned at once
_MANY: Final = 100_000
_MILLION: Final = 1_000_000


def measure(quick: bool) -> Iterator[Measurement]:
    """All figures, in turn; `quick` leaves out those of a million samples."""
    rng = np.random.default_rng(0)
    for n in (_PAGE, _MANY):
        anms = Anms(D, BUDGET)
        anms.extend(rng.uniform(0, 4, (n, D)), rng.uniform(size=n))
        yield _insert(anms, n, rng)
    yield _step(rng)
    yield from _predict(rng)
    yield _large_budget(rng)
    yield _fit(rng)
    yield from measure_guided()
    if not quick:
        yield from _million(rng)


def _times(rounds: int, calls: Mapping[str, Callable[[], object]], count: int = 1) -> dict[str, float]:
    """Median processor time of each call [us]."""
    return {name: p50(found) for name, found in in_turns(calls, rounds, count, thread_time).items()}


def _trials(rng: np.random.Generator, count: int, highest_cost: float = 1.0) -> list[Trial]:
    states, goals, costs = rng.uniform(0, 4, (count, D)), rng.uniform(-1, 1, (count, P)), rng.uniform(size=count)
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(count)]
    columns = zip(ids, states, goals, costs.tolist(), strict=True)
    return [Trial(one, state, goal, highest_cost * cost, True) for one, state, goal, cost in columns]


def _learner(budget: int, selector: Callable[[int, int], Anms] = Anms) -> Learner:
    return Learner(replace(bench_spec(budget), prior_mean="zero"), selector=selector)


def _add(learner: Learner, rng: np.random.Generator, count: int) -> Learner:
    with learner.bulk():
        for start in range(0, count, _PAGE):
            trials = _trials(rng, min(_PAGE, count - start))
            learner.apply_trials(range(learner.version + 1, learner.version + 1 + len(trials)), trials)
    return learner


def _scikit(model: Model) -> GaussianProcessRegressor:
    alpha = model.parameters.noise(model.costs)
    kernel = ConstantKernel(1.0) * RBF(model.parameters.kernel.lengthscales)
    return GaussianProcessRegressor(kernel, alpha=alpha, optimizer=None)


def _regression(learner: Learner) -> Regression:
    if learner.model.regression is None:
        raise RuntimeError("the learner has samples, so its model has a regression")
    return learner.model.regression


def _insert(anms: Anms, n: int, rng: np.random.Generator) -> Measurement:
    Z = rng.uniform(0, 4, (n, D))
    rounds = 40
    samples = zip(rng.uniform(0, 4, (rounds + 1, 1, D)), rng.uniform(size=(rounds + 1, 1)), strict=True)
    calls = {
        "insert": lambda: anms.extend(*next(samples)),
        "cdist": lambda: cdist(Z[:1], Z, "sqeuclidean"),
    }
    return ratio(f"one insert / one cdist row, n = {n:,}", _times(rounds, calls), "insert", "cdist", 2.5)


def _step(rng: np.random.Generator) -> Measurement:
    learner = _add(_learner(BUDGET), rng, _MANY)
    scikit, times = _scikit(learner.model), []
    for trial in _trials(rng, 200, 1e-3):  # better than nearly all, so that most become active
        before, states, goals = learner.active_ids, learner.model.states, learner.model.goals
        start = thread_time()
        learner.apply_trials([learner.version + 1], [trial])
        ours = thread_time() - start
        start = thread_time()
        scikit.fit(states, goals)
        if learner.active_ids != before:
            times.append((ours, thread_time() - start))
    ours, theirs = (p50(column) for column in np.array(times).T)
    what = "scikit-learn's fit / one learning step, k = 250, n = 100,000"
    behind = {"step us": ours, "fit us": theirs, "steps": float(len(times))}
    return Measurement(what, theirs / ours, 8.0, True, behind)


def _bare(regression: Regression, z: Array) -> tuple[Array, Array]:
    """Mean and variance by matrix operations alone."""
    k = np.exp(-0.5 * cdist(z, regression.Z, "sqeuclidean"))
    mean = k @ regression.W
    if len(z) == 1:
        v = blas.dtrsv(regression.L, k[0], lower=1)
        return mean, 1.0 - v @ v
    V = blas.dtrsm(1.0, regression.L, k.T, lower=1, overwrite_b=1)
    return mean, 1.0 - np.einsum("ij,ij->j", V, V)


def _predict(rng: np.random.Generator) -> Iterator[Measurement]:
    learner = _add(_learner(BUDGET), rng, BUDGET)
    model, states, regression = learner.model, rng.uniform(0, 4, (1000, D)), _regression(learner)
    scikit, z = _scikit(model).fit(model.states, model.goals), model.parameters.kernel.standardise(states)
    calls: dict[str, Callable[[], object]] = {
        "predict": lambda: learner.predict(states[0]),
        "scikit-learn": lambda: scikit.predict(states[:1], return_std=True),
        "bare": lambda: _bare(regression, z[:1]),
    }
    ours, theirs, bare = _times(300, calls, 10).values()
    behind = {"predict us": ours, "scikit-learn us": theirs, "bare us": bare}
    yield Measurement("scikit-learn's prediction / ours, one state, m = 250", theirs / ours, 4.0, True, behind)
    yield Measurement("one prediction / bare matrix operations", ours / bare, 2.0, False, behind)
    calls = {"batch": lambda: learner.predict(states), "bare": lambda: _bare(regression, z)}
    batch, bare = _times(60, calls).values()
    behind = {"1000 states us": batch, "bare us": bare}
    yield Measurement("states a second, 1000 in one call / single calls", 1000 * ours / batch, 5.0, True, behind)
    yield Measurement("1000 predictions in one call / bare matrix operations", batch / bare, 1.3, False, behind)


def _large_budget(rng: np.random.Generator) -> Measurement:
    regression = _regression(_add(_learner(1000), rng, 1000))
    kernel, Z, noise, Y = regression.kernel, regression.Z, regression.noise, rng.normal(size=(1000, P))
    K = kernel.matrix(Z, Z) + np.diag(noise)
    calls = {
        "new model": lambda: Regression.fit(kernel, Z.copy(), Y.copy(), noise.copy()),
        "cholesky": lambda: np.linalg.cholesky(K),
    }
    what = "new model at k = 1000 (refactored, no swaps) / numpy's cholesky"
    return ratio(what, _times(15, calls), "new model", "cholesky")


def _fit(rng: np.random.Generator) -> Measurement:
    learner = _add(_learner(BUDGET), rng, BUDGET)
    start = FitProblem.of(learner.model, learner.spec.lengthscales)
    smooth = np.sin(start.X @ rng.normal(size=(D, P)) / 3) + 0.1 * rng.normal(size=(BUDGET, P))
    problem = FitProblem(start.X, smooth, start.noise, 1e-4, start.lengthscales, 1.0, 0.0, start.reference)
    X = start.X / start.lengthscales
    K = np.asfortranarray(np.exp(-0.5 * cdist(X, X, "sqeuclidean")) + np.diag(np.maximum(start.noise, 1e-4)))
    calls: dict[str, Callable[[], object]] = {"fit": lambda: fit(problem), "factor": lambda: lapack.dpotrf(K, lower=1)}
    return ratio("cold fit, m = 250 / one factorisation", _times(15, calls), "fit", "factor", 100.0)


def _million(rng: np.random.Generator) -> Iterator[Measurement]:
    made: list[Anms] = []

    def remembered(dimensions: int, budget: int) -> Anms:
        made.append(Anms(dimensions, budget))
        return made[-1]

    learner = _add(_learner(BUDGET, remembered), rng, _MANY)
    before = resident()
    _add(learner, rng, _MILLION - _MANY)
    yield Measurement("resident bytes a sample, from 1e5 to 1e6", (resident() - before) / (_MILLION - _MANY), 600.0)
    yield _insert(made[0], _MILLION, rng)
