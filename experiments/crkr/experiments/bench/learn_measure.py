"""What `crkr bench learn` measures: the learner beside scikit-learn and beside the bare matrix operations.

Both sides of a ratio run in turns, in one process on one BLAS thread, and are timed by the thread's own clock, so that
other work on the machine matters little; a ratio is that of the medians.
"""

from __future__ import annotations

import json as json_format
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from time import thread_time
from typing import Final
from uuid import UUID

import numpy as np
import typer
from scipy.linalg import blas, lapack
from scipy.spatial.distance import cdist
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from crkr.experiments.bench.learn import Row
from crkr.learner import Anms, FitProblem, Learner, Model, Regression, fit, log_evidence
from crkr.protocol import Array, TaskSpec, Trial

__all__ = ["measure"]

D: Final = 6
P: Final = 13


def measure(quick: bool) -> Iterator[Row]:
    """All rows, in turn; `quick` leaves out what needs a million samples."""
    rng = np.random.default_rng(0)
    yield _equality(rng)
    for n in (10_000, 100_000):
        anms = Anms(D, 250)
        anms.extend(rng.uniform(0, 4, (n, D)), rng.uniform(size=n))
        yield _insert(anms, n, rng)
    yield _step(rng)
    yield from _predict(rng)
    yield _large_budget(rng)
    yield from _evidence(rng)
    if not quick:
        yield from _million(rng)


def _medians(rounds: int, *calls: Callable[[], object], inner: int = 1) -> list[float]:
    """Median processor time of each call [us], the calls taking turns."""
    times = np.empty((rounds, len(calls)))
    for turn in times:
        for column, call in enumerate(calls):
            start = thread_time()
            for _ in range(inner):
                call()
            turn[column] = thread_time() - start
    return [float(value) for value in np.median(times, axis=0) / inner * 1e6]


def _spec(budget: int) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": "bench",
            "state": [{"name": f"s{i}", "low": 0, "high": 4} for i in range(D)],
            "goal": [{"name": f"g{i}", "low": -4, "high": 4, "scale": 1} for i in range(P)],
            "prior_mean": "zero",
            "budget": budget,
        }
    )


def _trials(rng: np.random.Generator, count: int, highest_cost: float = 1.0) -> list[Trial]:
    states, goals, costs = rng.uniform(0, 4, (count, D)), rng.uniform(-1, 1, (count, P)), rng.uniform(size=count)
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(count)]
    columns = zip(ids, states, goals, costs.tolist(), strict=True)
    return [Trial(one, state, goal, highest_cost * cost, True) for one, state, goal, cost in columns]


def _filled(rng: np.random.Generator, count: int, budget: int) -> Learner:
    learner = Learner(_spec(budget))
    with learner.bulk():
        _add(learner, rng, count)
    return learner


def _add(learner: Learner, rng: np.random.Generator, count: int) -> None:
    for start in range(0, count, 10_000):
        trials = _trials(rng, min(10_000, count - start))
        learner.apply_trials(range(learner.version + 1, learner.version + 1 + len(trials)), trials)


def _scikit(model: Model) -> GaussianProcessRegressor:
    alpha = model.parameters.noise(model.costs)
    kernel = ConstantKernel(1.0) * RBF(model.parameters.kernel.lengthscales)
    return GaussianProcessRegressor(kernel, alpha=alpha, optimizer=None)


def _equality(rng: np.random.Generator) -> Row:
    worst = 0.0
    for _ in range(20):
        learner = _filled(rng, int(rng.integers(1, 500)), 500)
        model, queries = learner.model, rng.uniform(0, 4, (50, D))
        means, sigmas = _scikit(model).fit(model.states, model.goals).predict(queries, return_std=True)
        ours = learner.predict(queries)
        errors = [np.abs(ours.means - means).max() / np.abs(means).max(), np.abs(ours.sigmas / sigmas - 1).max()]
        worst = max(worst, *map(float, errors))
    return Row("mean and sigma: relative error against scikit-learn", worst, 1e-9, False, {})


def _insert(anms: Anms, n: int, rng: np.random.Generator) -> Row:
    Z = rng.uniform(0, 4, (n, D))
    rounds = max(40, 4_000_000 // n // 10)
    stream = iter(zip(rng.uniform(0, 4, (rounds, 1, D)), rng.uniform(size=(rounds, 1)), strict=True))
    ours, row = _medians(rounds, lambda: anms.extend(*next(stream)), lambda: cdist(Z[:1], Z, "sqeuclidean"))
    return Row(f"one insert / one cdist row, n = {n:,}", ours / row, 2.5, False, {"insert us": ours, "cdist us": row})


def _step(rng: np.random.Generator) -> Row:
    learner = _filled(rng, 100_000, 250)
    scikit, times = _scikit(learner.model), []
    stream = _trials(rng, 200, 1e-3)  # better than nearly all, so that most become active
    for trial in stream:
        before, states, goals = learner.active_ids, learner.model.states, learner.model.goals
        start = thread_time()
        learner.apply_trials([learner.version + 1], [trial])
        ours = thread_time() - start
        start = thread_time()
        scikit.fit(states, goals)
        if learner.active_ids != before:
            times.append((ours, thread_time() - start))
    ours, theirs = (float(value) * 1e6 for value in np.median(times, axis=0))
    detail = {"step us": ours, "fit us": theirs, "steps": float(len(times))}
    return Row("scikit-learn's fit / one learning step, k = 250, n = 100,000", theirs / ours, 8.0, True, detail)


def _bare(regression: Regression, z: Array) -> tuple[Array, Array]:
    """Mean and variance by nothing but the matrix operations."""
    k = np.exp(-0.5 * cdist(z, regression.Z, "sqeuclidean"))
    mean = k @ regression.W
    if len(z) == 1:
        v = blas.dtrsv(regression.L, k[0], lower=1)
        return mean, 1.0 - v @ v
    V = blas.dtrsm(1.0, regression.L, k.T, lower=1, overwrite_b=1)
    return mean, 1.0 - np.einsum("ij,ij->j", V, V)


def _predict(rng: np.random.Generator) -> Iterator[Row]:
    learner = _filled(rng, 250, 250)
    model, states = learner.model, rng.uniform(0, 4, (1000, D))
    scikit, regression = _scikit(model).fit(model.states, model.goals), model.regression
    if regression is None:
        raise RuntimeError("the learner has samples, so its model has a regression")
    z = model.parameters.kernel.standardise(states)
    ours, theirs, bare = _medians(
        300,
        lambda: learner.predict(states[0]),
        lambda: scikit.predict(states[:1], return_std=True),
        lambda: _bare(regression, z[:1]),
        inner=10,
    )
    detail = {"predict us": ours, "scikit-learn us": theirs, "bare us": bare}
    yield Row("scikit-learn's prediction / ours, one state, m = 250", theirs / ours, 4.0, True, detail)
    yield Row("one prediction / bare matrix operations", ours / bare, 2.0, False, detail)
    batch, bare = _medians(60, lambda: learner.predict(states), lambda: _bare(regression, z))
    detail = {"1000 states us": batch, "bare us": bare}
    yield Row("states a second, 1000 in one call / single calls", 1000 * ours / batch, 5.0, True, detail)
    yield Row("1000 predictions in one call / bare matrix operations", batch / bare, 1.3, False, detail)


def _large_budget(rng: np.random.Generator) -> Row:
    regression = _filled(rng, 1000, 1000).model.regression
    if regression is None:
        raise RuntimeError("the learner has samples, so its model has a regression")
    kernel, Z, noise, Y = regression.kernel, regression.Z, regression.noise, rng.normal(size=(1000, P))
    K = kernel.matrix(Z, Z) + np.diag(noise)
    ours, numpys = _medians(
        15, lambda: Regression.fit(kernel, Z.copy(), Y.copy(), noise.copy()), lambda: np.linalg.cholesky(K)
    )
    detail = {"new model us": ours, "cholesky us": numpys}
    return Row("new model at k = 1000 (refactored, no swaps) / numpy's cholesky", ours / numpys, None, False, detail)


def _evidence(rng: np.random.Generator) -> Iterator[Row]:
    learner = _filled(rng, 250, 250)
    start = FitProblem.of(learner.model, learner.spec.lengthscales)
    smooth = np.sin(start.X @ rng.normal(size=(D, P)) / 3) + 0.1 * rng.normal(size=(250, P))
    problem = FitProblem(start.X, smooth, start.noise, 1e-4, start.lengthscales, 1.0, 0.0, start.reference)
    theta = rng.uniform(-0.3, 0.5, D + 1)
    gradient, step = log_evidence(problem, theta)[1], 1e-3
    worst = 0.0
    for index in range(D + 1):
        around = [log_evidence(problem, theta + shift * step * np.eye(D + 1)[index])[0] for shift in (-2, -1, 1, 2)]
        difference = (around[0] - 8 * around[1] + 8 * around[2] - around[3]) / (12 * step)
        worst = max(worst, abs(difference - gradient[index]) / float(np.abs(gradient).max()))
    yield Row("evidence: relative error of the gradient", worst, 1e-6, False, {})
    X = start.X / start.lengthscales
    K = np.asfortranarray(np.exp(-0.5 * cdist(X, X, "sqeuclidean")) + np.diag(np.maximum(start.noise, 1e-4)))
    ours, factor = _medians(15, lambda: fit(problem), lambda: lapack.dpotrf(K, lower=1))
    detail = {"fit us": ours, "factor us": factor}
    yield Row("cold fit, m = 250 / one factorisation", ours / factor, 100.0, False, detail)


def _resident() -> float:
    """Resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


def _million(rng: np.random.Generator) -> Iterator[Row]:
    made: list[Anms] = []

    def remembered(dimensions: int, budget: int) -> Anms:
        made.append(Anms(dimensions, budget))
        return made[-1]

    learner = Learner(_spec(250), selector=remembered)
    with learner.bulk():
        _add(learner, rng, 100_000)
    before = _resident()
    with learner.bulk():
        _add(learner, rng, 900_000)
    each = (_resident() - before) / 900_000
    yield Row("resident bytes a sample, from 1e5 to 1e6", each, 600.0, False, {})
    yield _insert(made[0], 1_000_000, rng)


def _main(quick: bool = False) -> None:
    rows = []
    for row in measure(quick):
        typer.echo(f"{row.what}: {row.value:.3g}", err=True)
        rows.append(asdict(row))
    typer.echo(json_format.dumps(rows))


if __name__ == "__main__":
    typer.run(_main)
