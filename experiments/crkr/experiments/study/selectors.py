"""Rival rules for the active set: each is a function of all ordered samples, evaluated after every change."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from hashlib import blake2b
from heapq import heapify, heappop, heappush
from typing import Final, final

import numpy as np
from scipy.linalg import lapack
from scipy.spatial.distance import cdist

from crkr.learner import SELECTORS, SelectorFactory
from crkr.learner.selection.selector import Radii, Standing
from crkr.protocol import Array

__all__ = ["RIVAL_SELECTORS", "Rule", "RuleSelector"]

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]
Rule = Callable[[Array, Array, int], "Indices"]
"""Positions of at most `budget` of n > budget samples, states Z (n, d) and costs (n,) in order of arrival."""

NEAREST: Final = 3  # better samples that novelty is measured from
NOISE_FLOOR: Final = 1e-4


@final
class RuleSelector:
    """A `Selector` that applies a rule to all its samples at each change."""

    def __init__(self, dimensions: int, budget: int, rule: Rule) -> None:
        self._budget, self._rule = budget, rule
        self._Z, self._costs = np.empty((0, dimensions)), np.empty(0)
        self._there = np.empty(0, bool)
        self._active: Indices | None = None

    @property
    def active(self) -> Indices:
        """Numbers of the active samples, ascending."""
        if self._active is None:
            numbers = np.flatnonzero(self._there)
            if len(numbers) > self._budget:
                numbers = numbers[np.sort(self._rule(self._Z[numbers], self._costs[numbers], self._budget))]
            numbers.flags.writeable = False
            self._active = numbers
        return self._active

    def extend(self, Z: Array, costs: Array) -> None:
        """Adds samples."""
        self._Z, self._costs = np.concatenate([self._Z, Z]), np.concatenate([self._costs, costs])
        self._there = np.concatenate([self._there, np.ones(len(costs), bool)])
        self._active = None

    def remove(self, indices: Indices | int) -> None:
        """Removes samples."""
        self._there[indices] = False
        self._active = None

    def recost(self, indices: Indices | int, costs: Array | float) -> None:
        """Changes costs."""
        self._costs[indices] = costs
        self._active = None

    def rebuild(self, Z: Array, costs: Array, radii: Radii | None = None) -> None:
        """Replaces all samples by these."""
        del radii  # Unused: there are none.
        self._Z, self._costs, self._there = Z.copy(), costs.copy(), np.ones(len(costs), bool)
        self._active = None

    def set_budget(self, budget: int) -> None:
        """Changes the number of samples that may be active."""
        self._budget = budget
        self._active = None

    def standing(self, index: int) -> Standing:
        """None: rules have no status of single samples."""
        del index  # Unused.
        return Standing(None, None)

    def radii(self) -> None:
        """None: there are no radii."""


def recency(Z: Array, costs: Array, budget: int) -> Indices:
    """The newest samples."""
    del Z  # Unused.
    return np.arange(len(costs) - budget, len(costs))


def reservoir(Z: Array, costs: Array, budget: int) -> Indices:
    """A uniform random choice, also for new samples: the least hashes of states."""
    del costs  # Unused.
    keys = [blake2b(row.tobytes(), digest_size=8).digest() for row in np.ascontiguousarray(Z)]
    return np.array(sorted(range(len(keys)), key=keys.__getitem__)[:budget])


def lowest_cost(Z: Array, costs: Array, budget: int) -> Indices:
    """The cheapest samples, older ones first where costs are equal."""
    del Z  # Unused.
    return np.argsort(costs, kind="stable")[:budget]


def farthest_point(Z: Array, costs: Array, budget: int) -> Indices:
    """Greedily the sample farthest from those chosen, from the oldest on: coverage without costs."""
    del costs  # Unused.
    chosen, distance = [0], cdist(Z[:1], Z)[0]
    for _ in range(budget - 1):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, cdist(Z[chosen[-1:]], Z)[0])
    return np.array(chosen)


def cover(Z: Array, costs: Array, budget: int) -> Indices:
    """The cheapest samples at least a radius apart; the radius is the least one within the budget."""
    order = np.argsort(costs, kind="stable")
    apart = cdist(Z[order], Z[order])

    def kept(radius: float) -> Indices:
        free, found = np.ones(len(order), bool), list[int]()
        while free.any():
            position = int(np.argmax(free))
            found.append(position)
            free &= apart[position] > radius
            free[position] = False
        return order[found]

    low, high = 0.0, float(apart.max())
    for _ in range(20):
        middle = (low + high) / 2
        low, high = (low, middle) if len(kept(middle)) <= budget else (middle, high)
    return kept(high)[:budget]


def information_gain(Z: Array, costs: Array, budget: int) -> Indices:
    """Greedily the sample with the largest variance relative to its noise, by pivoted Cholesky factorisation.

    The noise of a sample is its cost, as in Cost-regularized Kernel Regression with lambda of one.
    """
    noise = costs + NOISE_FLOOR
    variance, factor = np.ones(len(Z)), np.zeros((budget, len(Z)))
    chosen: list[int] = []
    for step in range(budget):
        gain = variance / noise
        gain[chosen] = -1.0
        best = int(np.argmax(gain))
        chosen.append(best)
        row = np.exp(-0.5 * cdist(Z[best : best + 1], Z, "sqeuclidean")[0])
        row -= factor[:step].T @ factor[:step, best]
        factor[step] = row / np.sqrt(variance[best] + noise[best])
        variance = np.maximum(variance - factor[step] ** 2, 0.0)
    return np.array(chosen)


def dominated_novelty(Z: Array, costs: Array, budget: int) -> Indices:
    """Samples with the largest mean distance to their three nearest better ones."""
    order = np.argsort(costs, kind="stable")
    apart = cdist(Z[order], Z[order])
    apart[np.triu_indices(len(order))] = np.inf  # worse ones, and itself
    nearest = np.sort(apart, axis=1)[:, :NEAREST]
    finite = np.isfinite(nearest)
    novelty = np.where(finite, nearest, 0.0).sum(axis=1) / np.maximum(finite.sum(axis=1), 1)
    novelty[0] = np.inf  # nothing is better than the best
    return order[np.argsort(-novelty, kind="stable")[:budget]]


def splits(Z: Array, costs: Array, budget: int) -> Indices:
    """The cheapest sample of each cell; the fullest cell is split at the median of its longest side.

    A learner that splits [Cardoso2017, its reference 11] answers from the samples of one cell. These depend on the
    query, so they are not an active set; this rule keeps the best sample of every cell instead.
    """
    cells = [(-len(Z), 0, np.arange(len(Z)))]
    heapify(cells)
    while len(cells) < budget:
        _, _, cell = heappop(cells)
        side = int(np.argmax(np.ptp(Z[cell], axis=0)))
        order = cell[np.argsort(Z[cell, side], kind="stable")]
        for half in np.array_split(order, 2):
            heappush(cells, (-len(half), int(half[0]), half))
    return np.array([cell[np.lexsort((cell, costs[cell]))[0]] for _, _, cell in cells])


@final
class Independence:
    """A dictionary in which a new sample replaces the least independent one  [NguyenTuong2011].

    Independence of a sample is its variance given the others: 1 / diag(K^-1), for the kernel matrix K with a small
    noise. The rule ignores costs. It depends on the order of arrival, so it continues from the last samples if the new
    ones begin with them.
    """

    def __init__(self) -> None:
        self._seen, self._kept, self._budget = np.empty((0, 0)), list[int](), 0

    def __call__(self, Z: Array, costs: Array, budget: int) -> Indices:
        """The dictionary after all samples."""
        del costs  # Unused.
        if budget != self._budget or not np.array_equal(self._seen, Z[: len(self._seen)]):
            self._seen, self._kept, self._budget = Z[:0], [], budget
        for number in range(len(self._seen), len(Z)):
            self._kept.append(number)
            if len(self._kept) > budget:
                del self._kept[self._least(Z[self._kept])]
        self._seen = Z.copy()
        return np.array(self._kept)

    @staticmethod
    def _least(Z: Array) -> int:
        """Position of the least independent row, the newest among equals."""
        K = np.exp(-0.5 * cdist(Z, Z, "sqeuclidean"))
        K.flat[:: len(K) + 1] += NOISE_FLOOR
        factor, _ = lapack.dpotrf(K.T, lower=1, overwrite_a=1)
        inverse, _ = lapack.dpotri(factor, lower=1, overwrite_c=1)
        return len(K) - 1 - int(np.argmax(np.diag(inverse)[::-1]))


RULES: Final[Mapping[str, Rule]] = {
    "recency": recency,
    "reservoir": reservoir,
    "lowest-cost": lowest_cost,
    "farthest-point": farthest_point,
    "cover": cover,
    "information-gain": information_gain,
    "dominated-novelty": dominated_novelty,
    "splits": splits,
}


def _independence(dimensions: int, budget: int) -> RuleSelector:
    return RuleSelector(dimensions, budget, Independence())


RIVAL_SELECTORS: Final[Mapping[str, SelectorFactory]] = {
    **SELECTORS,
    **{name: partial(RuleSelector, rule=rule) for name, rule in RULES.items()},
    "independence": _independence,
}
