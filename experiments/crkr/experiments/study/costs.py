"""Cost of a trial by the number of samples: learning one more success, and asking for one goal.

Every number is a mean of processor time, as only some trials change the active set. Ways take turns, so that other load
affects all equally.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count, islice
from time import thread_time
from typing import Final, final

import numpy as np
from scipy.linalg import blas

from crkr.client.cli.console import print_table
from crkr.experiments.study.approximators import APPROXIMATORS, Way
from crkr.experiments.study.selectors import RIVAL_SELECTORS
from crkr.learner import Kernel, Learner
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult
from crkr.sim_worker.table_tennis.ball.launchers import LAUNCHERS
from crkr.sim_worker.table_tennis.spec import task_spec

__all__ = ["AppendedRows", "print_costs", "trial_costs"]

SIZES: Final = (250, 500, 1000, 1500, 2500)
ROUNDS: Final = 30


@final
class AppendedRows:
    """Regression on all samples at the least cost: the factor grows by a row, and nothing is recomputed.

    L is kept packed, row by row, and beside it B = L^-1 Y, so that a new sample is one triangular solve and so is a
    prediction, with mean b.B and variance k(z, z) - b.b for b = L^-1 k(z).
    """

    def __init__(self, kernel: Kernel, most: int, goals: int) -> None:
        self._kernel, self.count = kernel, 0
        self._Z, self._B = np.empty((most, len(kernel.centre))), np.empty((most, goals))
        self._packed = np.empty(most * (most + 1) // 2)

    def append(self, z: Array, y: Array, noise: float) -> None:
        """One more sample: standardised state (d,), scaled goal (p,)."""
        n, prior = self.count, float(self._kernel.variance(z[None])[0]) + noise
        row = self._solved(z)
        pivot = np.sqrt(prior - row @ row)
        first = n * (n + 1) // 2
        self._packed[first : first + n], self._packed[first + n] = row, pivot
        self._Z[n], self._B[n] = z, (y - row @ self._B[:n]) / pivot
        self.count += 1

    def at(self, z: Array) -> tuple[Array, float]:
        """Mean (p,) and variance at a standardised state (d,)."""
        row = self._solved(z)
        return row @ self._B[: self.count], float(self._kernel.variance(z[None])[0] - row @ row)

    def _solved(self, z: Array) -> Array:
        n = self.count
        if not n:
            return np.empty(0)
        k = self._kernel.matrix(z[None], self._Z[:n])[0]
        solved: Array = blas.dtpsv(n, self._packed[: n * (n + 1) // 2], k, lower=0, trans=1)
        return solved


def print_costs(rules: Sequence[str], budgets: Sequence[int]) -> None:
    """Measures and prints milliseconds a trial, of the rules at each budget and of appended rows."""
    ways = {way.name: way for way in (Way(rule, budget, 1.0) for budget in budgets for rule in rules)}
    found = {size: trial_costs(ways, size) for size in SIZES}
    lines = [(name, *(f"{found[size][name]:.2f}" for size in SIZES)) for name in found[SIZES[0]]]
    title = "one goal asked for and one success learned: mean milliseconds of processor time"
    print_table(("", *(f"at {size}" for size in SIZES)), lines, title)


def trial_costs(ways: Mapping[str, Way], size: int, rounds: int = ROUNDS) -> dict[str, float]:
    """Mean milliseconds of a trial of each way once there are `size` successes, and of appended rows."""
    spec = task_spec(LAUNCHERS["nominal"], "paper")
    calls = {name: _trial(way, spec, size) for name, way in ways.items()}
    calls["full, rows appended at best"] = _appended(spec, size, rounds)
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            before = thread_time()
            call()
            taken[name].append(1e3 * (thread_time() - before))
    return {name: float(np.mean(times)) for name, times in taken.items()}


def _samples(spec: TaskSpec) -> Iterator[tuple[Array, Array, float]]:
    """States in the task's box, goals that depend on them, and costs that fall slowly, as during learning."""
    rng = np.random.default_rng(0)
    low, high = (np.array([getattr(axis, side) for axis in spec.state]) for side in ("low", "high"))
    mixing = rng.normal(size=(len(spec.state), len(spec.goal)))
    for number in count():
        at = rng.uniform(size=len(low))
        yield (
            low + at * (high - low),
            np.clip(spec.scales * np.tanh(at @ mixing), *spec.bounds),
            float(rng.uniform() / (1 + number / 500)),
        )


def _trial(way: Way, spec: TaskSpec, size: int) -> Callable[[], object]:
    """One trial of a learner that has `size` successes, all reported at once: only the trial is timed."""
    samples = _samples(spec)
    first = list(islice(samples, size))
    if way.rule in APPROXIMATORS:
        rival = way(spec, 0)
        rival.start([Demonstration(state, goal, _success(cost)) for state, goal, cost in first])

        def approximate() -> None:
            state, goal, cost = next(samples)
            rival.ask(state)
            rival.tell(state, goal, _success(cost))

        return approximate
    learner = Learner(way.changed(spec), selector=RIVAL_SELECTORS[way.rule])
    states, goals, costs = map(np.array, zip(*first, strict=True))
    learner.report(state=states, goal=goals, cost=costs, success=True)

    def learn() -> None:
        state, goal, cost = next(samples)
        learner.predict(state, explore=True)
        learner.report(state=state, goal=goal, cost=cost, success=True)

    return learn


def _success(cost: float) -> TrialResult:
    return TrialResult(cost=cost, success=True, executed=True)


def _appended(spec: TaskSpec, size: int, rounds: int) -> Callable[[], object]:
    kernel = Kernel(spec.centres, spec.lengthscales, spec.kernel.signal_variance)
    samples, rows = _samples(spec), AppendedRows(kernel, size + rounds, len(spec.goal))

    def step() -> None:
        state, goal, cost = next(samples)
        z = kernel.standardise(state)
        rows.at(z)
        rows.append(z, goal / spec.scales, cost + 1e-2)

    for _ in range(size):
        step()
    return step
