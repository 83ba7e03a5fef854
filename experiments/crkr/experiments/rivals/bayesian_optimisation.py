"""Contextual Bayesian optimisation of a composite objective by BoTorch."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Final, final

import numpy as np
import torch
from botorch.acquisition import FixedFeatureAcquisitionFunction, qSimpleRegret, qUpperConfidenceBound
from botorch.acquisition.objective import GenericMCObjective
from botorch.fit import fit_gpytorch_mll
from botorch.generation import gen_candidates_scipy
from botorch.models import ModelListGP, SingleTaskGP
from botorch.models.transforms import Normalize, Standardize
from botorch.sampling import SobolQMCNormalSampler
from gpytorch.mlls import SumMarginalLogLikelihood

from crkr.experiments.rivals.rival import Offsets
from crkr.protocol import Array, Invalid, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["CompositeOptimisation"]

NOISE: Final = 0.1  # of an outcome [tolerances], and as a share of its distance from the target
REFIT: Final = 1.1
REACH: Final = 2.0  # of the trust region around behaviour cloning [scales of the goal]
BETA: Final = 0.1
STARTS: Final = 2  # of the search for one goal
SAMPLES: Final = 16
FIT_STEPS: Final = 50
SEARCH_STEPS: Final = 40


@final
class CompositeOptimisation:
    """A Gaussian process for each entry of the outcome, and the upper confidence bound of their joint objective.

    Contexts are inputs that the search for a goal keeps fixed. Goals are offsets from behaviour cloning, within a trust
    region. The model is refitted after each tenth more trials, as with seven entries that takes over a second.
    """

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        if not spec.outcome:
            raise Invalid("a composite objective needs a task with outcomes")
        torch.set_num_threads(1)
        self._spec, self._seed = spec, seed
        self._rng = np.random.default_rng(seed)
        self._trials: list[tuple[Array, Array]] = []
        self._known = 0

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Sets scales from them, and adds them as the first trials."""
        self._offsets = Offsets(self._spec, demonstrations)
        self._sides = torch.as_tensor(self._offsets.scales.side)
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """The goal of the highest bound, of several searches."""
        states = np.repeat(state[None, :], STARTS, axis=0)
        starts = self._rng.uniform(-REACH, REACH, (STARTS, len(self._spec.goal))) / 4
        starts[0] = 0.0
        self._fit()
        bound = qUpperConfidenceBound(self._model, BETA, self._sampler(), self._objective())
        found, values = self._search(states, starts, bound)
        goal: Array = self._offsets.goals(state[None, :], found[np.argmax(values)][None, :])[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Adds the outcome."""
        if result.outcome is not None:
            x = np.concatenate([self._offsets.scales.states(state), self._offsets.of(state, goal)])
            self._trials.append((x, self._offsets.scales.outcomes(result.outcome)))

    def policy(self, states: Array) -> Array:
        """The goals of the highest expected objective, found together."""
        self._fit()
        mean = qSimpleRegret(self._model, self._sampler(), self._objective())
        found, _ = self._search(states, np.zeros((len(states), len(self._spec.goal))), mean)
        return self._offsets.goals(states, found)

    def _sampler(self) -> SobolQMCNormalSampler:
        return SobolQMCNormalSampler(torch.Size([SAMPLES]), seed=self._seed)

    def _objective(self) -> GenericMCObjective:
        def score(outcomes: Any, X: Any = None) -> Any:
            del X  # Unused.
            wrong = (self._sides == 0) | (torch.sign(outcomes) == self._sides)
            return -torch.sqrt(1 + (torch.where(wrong, outcomes, 0.0) ** 2).sum(-1))

        return GenericMCObjective(score)

    def _search(self, states: Array, starts: Array, acquisition: Any) -> tuple[Array, Array]:
        """Offsets (b, p) of the best goals in states (b, d), each from its start, and their values (b,)."""
        z = torch.as_tensor(self._offsets.scales.states(states))[:, None, :]
        d = z.shape[-1]
        fixed = FixedFeatureAcquisitionFunction(acquisition, d + starts.shape[1], list(range(d)), z)
        found, values = gen_candidates_scipy(
            torch.as_tensor(starts)[:, None, :], fixed, -REACH, REACH, options={"maxiter": SEARCH_STEPS},
            use_parallel_mode=False,
        )  # fmt: skip
        return found[:, 0].detach().numpy(), values.detach().numpy()

    def _fit(self) -> None:
        if len(self._trials) < REFIT * self._known:
            return
        self._known = len(self._trials)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # demonstrations may agree in an entry, and fits are cut short
            self._model = ModelListGP(*self._processes())
            fit_gpytorch_mll(
                SumMarginalLogLikelihood(self._model.likelihood, self._model),
                optimizer_kwargs={"options": {"maxiter": FIT_STEPS}},
            )

    def _processes(self) -> Iterator[SingleTaskGP]:
        x, y = (np.array(part) for part in zip(*self._trials, strict=True))
        noise = NOISE**2 * (1 + y**2)
        unseen = ~np.isfinite(y).any(axis=0)  # a process needs a trial: one at the target, with a huge noise
        y[0, unseen], noise[0, unseen] = 0.0, 1e6
        for entry, variance in zip(y.T, noise.T, strict=True):
            seen = np.isfinite(entry)
            data = [torch.as_tensor(part[seen])[..., None] for part in (entry, variance)]
            yield SingleTaskGP(
                torch.as_tensor(x[seen]), *data,
                input_transform=Normalize(x.shape[1]), outcome_transform=Standardize(1),
            )  # fmt: skip
