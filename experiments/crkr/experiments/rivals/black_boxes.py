"""Black-box optimisers, which know no contexts: one for the contexts around each demonstration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, Protocol, final

import numpy as np
from scipy.spatial import cKDTree

from crkr.experiments.rivals.rival import Offsets, cost_of
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["FixedContexts", "nevergrad_tbpsa", "optuna_tpe"]

REACH: Final = 2.0  # of the offsets that are searched [scales of the goal]
START: Final = 0.3  # deviation of the first offsets
BUDGET: Final = 300  # Nevergrad's budget of each optimiser


class Optimiser(Protocol):
    """Minimises the cost of one vector (p,), each entry within REACH."""

    def ask(self) -> Array:
        """The next vector."""

    def tell(self, cost: float) -> None:
        """Takes the cost of the last vector."""

    def best(self) -> Array:
        """The recommended vector."""


@final
class FixedContexts:
    """Fixes the context to the nearest demonstration; each has an optimiser of offsets from behaviour cloning."""

    def __init__(self, spec: TaskSpec, seed: int, make: Callable[[int, int], Optimiser]) -> None:
        self._spec, self._seed, self._make = spec, seed, make

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Makes the optimisers."""
        self._offsets = Offsets(self._spec, demonstrations)
        self._scales = self._offsets.scales
        states = np.array([shown.state for shown in demonstrations])
        self._nearest = cKDTree(self._scales.states(states))
        count = len(self._spec.goal)
        self._optimisers = [self._make(count, len(states) * self._seed + number) for number in range(len(states))]

    def ask(self, state: Array) -> Array:
        """The next goal of the nearest demonstration's optimiser."""
        goal: Array = self._offsets.goals(state[None, :], self._optimiser(state).ask()[None, :])[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Tells that optimiser the cost."""
        del goal  # Unused: it is the goal of the last `ask`.
        self._optimiser(state).tell(cost_of(result))

    def policy(self, states: Array) -> Array:
        """The recommendations of the nearest demonstrations' optimisers."""
        best = np.array([one.best() for one in self._optimisers])
        return self._offsets.goals(states, best[self._nearest.query(self._scales.states(states))[1]])

    def _optimiser(self, state: Array) -> Optimiser:
        _, nearest = self._nearest.query(self._scales.states(state))
        return self._optimisers[int(nearest)]


@final
class _Optuna:
    """A study with the multivariate tree-structured Parzen estimator; its first trial is no offset."""

    def __init__(self, count: int, seed: int) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True)
        self._study = optuna.create_study(sampler=sampler)
        self._names = [f"x{number}" for number in range(count)]
        self._within = {name: optuna.distributions.FloatDistribution(-REACH, REACH) for name in self._names}
        self._study.enqueue_trial(dict.fromkeys(self._names, 0.0))
        self._told = False

    def ask(self) -> Array:
        self._trial = self._study.ask(self._within)
        return np.array([self._trial.params[name] for name in self._names])

    def tell(self, cost: float) -> None:
        self._study.tell(self._trial, cost)
        self._told = True

    def best(self) -> Array:
        if not self._told:
            return np.zeros(len(self._names))
        return np.array([self._study.best_params[name] for name in self._names])


@final
class _Nevergrad:
    """TBPSA, which Nevergrad recommends for noisy costs."""

    def __init__(self, count: int, seed: int) -> None:
        import nevergrad

        offset = nevergrad.p.Array(init=np.zeros(count)).set_mutation(sigma=START).set_bounds(-REACH, REACH)
        offset.random_state.seed(seed)
        self._optimiser = nevergrad.optimizers.TBPSA(parametrization=offset, budget=BUDGET)

    def ask(self) -> Array:
        self._asked = self._optimiser.ask()
        return np.asarray(self._asked.value)

    def tell(self, cost: float) -> None:
        self._optimiser.tell(self._asked, cost)

    def best(self) -> Array:
        return np.asarray(self._optimiser.provide_recommendation().value)


def optuna_tpe(spec: TaskSpec, seed: int) -> FixedContexts:
    """Optuna's estimator of Parzen trees, with contexts fixed."""
    return FixedContexts(spec, seed, _Optuna)


def nevergrad_tbpsa(spec: TaskSpec, seed: int) -> FixedContexts:
    """Nevergrad's TBPSA, with contexts fixed."""
    return FixedContexts(spec, seed, _Nevergrad)
