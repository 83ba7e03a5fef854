"""Approximations of regression on all samples, and the rules that the study compares.

    Z  (n, d)  standardised states of all samples      u  (m,)    positions of the samples that ANMS keeps
    Y  (n, p)  scaled goals minus their prior mean     N  (n,)    noise variances

A selector chooses samples before the query is known, and the learner regresses on these alone. An approximator uses
other samples for every query, or all of them. It learns as preset `paper` does, from the same draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final, NamedTuple, final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel

from crkr.experiments.rivals.rival import Crkr, Rival
from crkr.experiments.study.selectors import RIVAL_SELECTORS
from crkr.learner import Anms, GaussianExplorer, Kernel, Parameters, Regression
from crkr.protocol import Array, TaskSpec, training_id
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["APPROXIMATORS", "RULES", "ApproximateLearner", "Way"]

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]
Posterior = Callable[[Array], tuple[Array, Array]]
"""Means (b, p) and variances (b,) at standardised states (b, d)."""
Approximator = Callable[[Kernel, Array, Array, Array, "Indices"], Posterior]
"""A posterior from kernel, Z, Y, N and u."""

NEAREST: Final = 60
JITTER: Final = 1e-8  # of the signal variance


def exact(kernel: Kernel, Z: Array, Y: Array, N: Array, u: Indices) -> Posterior:
    """scikit-learn's regression on the samples that ANMS keeps: the learner's own, by other code."""
    amplitude = ConstantKernel(kernel.signal_variance, "fixed")
    model = GaussianProcessRegressor(amplitude * RBF(1.0, "fixed"), alpha=N[u], optimizer=None).fit(Z[u], Y[u])

    def posterior(z: Array) -> tuple[Array, Array]:
        mean, deviation = model.predict(z, return_std=True)
        return np.asarray(mean), np.asarray(deviation)[:, 0] ** 2

    return posterior


def deterministic_training(kernel: Kernel, Z: Array, Y: Array, N: Array, u: Indices) -> Posterior:
    """All samples, with ANMS's choice as inducing points  [Quinonero2005, DTC].

    SGPR with these inducing points has the same means and variances; it differs in how it would choose the kernel.
    """
    weight = 1.0 / np.sqrt(N)
    inner = kernel.matrix(Z[u], Z[u])
    inner.flat[:: len(u) + 1] += JITTER * kernel.signal_variance
    L = np.linalg.cholesky(inner)
    A = solve_triangular(L, kernel.matrix(Z[u], Z) * weight, lower=True)  # (m, n)
    M = np.linalg.cholesky(np.eye(len(u)) + A @ A.T)
    c = solve_triangular(M, A @ (weight[:, None] * Y), lower=True)  # (m, p)

    def posterior(z: Array) -> tuple[Array, Array]:
        a = solve_triangular(L, kernel.matrix(Z[u], z), lower=True)
        b = solve_triangular(M, a, lower=True)
        return b.T @ c, np.maximum(kernel.variance(z) - (a * a).sum(axis=0) + (b * b).sum(axis=0), 0.0)

    return posterior


def nearest(kernel: Kernel, Z: Array, Y: Array, N: Array, u: Indices, *, everything: bool) -> Posterior:
    """Regression on the samples nearest to each query, among all or among those that ANMS keeps."""
    Z, Y, N = (Z, Y, N) if everything else (Z[u], Y[u], N[u])

    def posterior(z: Array) -> tuple[Array, Array]:
        found = []
        for one, distances in zip(z, cdist(z, Z, "sqeuclidean"), strict=True):
            near = np.sort(np.argsort(distances, kind="stable")[:NEAREST])
            found.append(Regression.fit(kernel, Z[near], Y[near], N[near]).at(one)[:2])
        means, variances = zip(*found, strict=True)
        return np.array(means), np.array(variances)

    return posterior


@final
class ApproximateLearner:
    """A `Rival` that regresses by an approximator; without outcomes, as in the paper.

    Args:
        spec: The task, with budget, trade-off, kernel and prior mean; its outcomes are ignored.
        seed: Of the draws.
        approximator: Regresses on the successes.
    """

    def __init__(self, spec: TaskSpec, seed: int, approximator: Approximator) -> None:
        self._spec = TaskSpec.from_dict({**spec.to_dict(), "seed": seed})
        own = self._spec
        self._kernel = Kernel(own.centres, own.lengthscales, own.kernel.signal_variance, own.kernel.linear_weight)
        self._explorer, self._approximator = GaussianExplorer.of(own), approximator
        self._anms = Anms(len(own.state), own.budget)
        self._Z, self._goals = np.empty((0, len(own.state))), np.empty((0, len(own.goal)))
        self._costs, self._trials = np.empty(0), 0
        self._posterior: Posterior | None = None

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Adds them as successes; their mean goal is the prior's if the task says so."""
        own, prior = self._spec, np.zeros(len(self._spec.goal))
        if own.prior_mean == "demonstrations":
            prior = np.mean([shown.goal for shown in demonstrations], axis=0)
        self._parameters = Parameters.create(own, self._kernel, prior)
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """A draw of the posterior within the bounds, the same that the learner makes in this trial."""
        self._trials += 1
        trial_id = training_id(self._spec.name, self._spec.seed, 1, self._trials)
        means, variances = self._predict(state[None])
        sigmas = self._parameters.scales * (self._parameters.explore_scale * np.sqrt(variances[0]))
        return self._explorer.draw(state, means[0], sigmas, [trial_id]).goals

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Keeps successes."""
        if not (result.success and result.executed):
            return
        z, cost = self._kernel.standardise(state)[None], np.array([1.0 if result.cost is None else result.cost])
        self._anms.extend(z, cost)
        self._Z, self._goals = np.concatenate([self._Z, z]), np.concatenate([self._goals, goal[None]])
        self._costs, self._posterior = np.concatenate([self._costs, cost]), None

    def policy(self, states: Array) -> Array:
        """Means of the posterior within the bounds."""
        means, _ = self._predict(states)
        clipped: Array = np.clip(means, self._explorer.low, self._explorer.high)
        return clipped

    def _predict(self, states: Array) -> tuple[Array, Array]:
        own = self._parameters
        if self._posterior is None:
            Y = (self._goals - own.prior) / own.scales
            self._posterior = self._approximator(self._kernel, self._Z, Y, own.noise(self._costs), self._anms.active)
        means, variances = self._posterior(self._kernel.standardise(states))
        return own.prior + means * own.scales, variances


APPROXIMATORS: Final[Mapping[str, Approximator]] = {
    "anms-by-scikit-learn": exact,
    "all-by-dtc": deterministic_training,
    "all-by-nearest": partial(nearest, everything=True),
    "anms-by-nearest": partial(nearest, everything=False),
}
RULES: Final = (*RIVAL_SELECTORS, *APPROXIMATORS)
WITHOUT_BUDGET: Final = ("full", "all-by-nearest")  # these use all samples; one run serves for every budget


class Way(NamedTuple):
    """A rule with its budget and trade-off; called with a specification and a seed, it makes a learner."""

    rule: str
    budget: int
    tradeoff: float

    @property
    def name(self) -> str:
        """Its name in the table."""
        if self.rule in WITHOUT_BUDGET:
            return f"{self.rule}, lambda {self.tradeoff:g}"
        return f"{self.rule}, budget {self.budget}, lambda {self.tradeoff:g}"

    def __call__(self, spec: TaskSpec, seed: int) -> Rival:
        """Make a learner."""
        if self.rule in APPROXIMATORS:
            return ApproximateLearner(self.changed(spec), seed, APPROXIMATORS[self.rule])
        return Crkr(self.changed(spec), seed, RIVAL_SELECTORS[self.rule])

    def changed(self, spec: TaskSpec) -> TaskSpec:
        """The specification with this budget and trade-off."""
        return spec.with_changes({"budget": self.budget, "regularisation": self.tradeoff})
