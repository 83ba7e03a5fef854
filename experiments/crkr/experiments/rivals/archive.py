"""Quality diversity: pyribs keeps the best goal of each region of contexts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, final

import numpy as np
from ribs.archives import CVTArchive
from ribs.emitters.operators import IsoLineOperator
from scipy.spatial import cKDTree

from crkr.experiments.rivals.rival import Offsets, cost_of
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["EliteArchive"]

CELLS: Final = 200
SAMPLES: Final = 10_000  # contexts from which the cells are made
ISO, LINE = 0.1, 0.2  # deviations of a variation: in all directions [scales], and towards another elite


@final
class EliteArchive:
    """An archive whose measures are the context; the iso-line operator varies the elite nearest to a context.

    Elites are offsets from behaviour cloning, so that each serves the contexts around it.
    """

    def __init__(self, spec: TaskSpec, seed: int) -> None:
        self._spec, self._seed = spec, seed
        self._rng = np.random.default_rng(seed)
        self._vary = IsoLineOperator(ISO, LINE, seed=seed)

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Makes the cells, and adds the demonstrations."""
        self._offsets = Offsets(self._spec, demonstrations)
        self._scales = self._offsets.scales
        plain = self._spec.to_dict()["state"]
        low, high = (self._scales.states(np.array([entry[side] for entry in plain])) for side in ("low", "high"))
        self._archive = CVTArchive(
            solution_dim=len(self._spec.goal), centroids=CELLS, ranges=list(zip(low, high, strict=True)),
            samples=SAMPLES, seed=self._seed,
        )  # fmt: skip
        for shown in demonstrations:
            self.tell(shown.state, shown.goal, shown.result)

    def ask(self, state: Array) -> Array:
        """A variation of the nearest elite, along the line to a random one."""
        parents = np.array([self._elites(state[None, :]), self._archive.sample_elites(1)["solution"]])
        goal: Array = self._offsets.goals(state[None, :], self._vary.ask(parents))[0]
        return goal

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Offers the trial to the archive."""
        self._archive.add_single(self._offsets.of(state, goal), -cost_of(result), self._scales.states(state))

    def policy(self, states: Array) -> Array:
        """The elites of the nearest cells that have one."""
        return self._offsets.goals(states, self._elites(states))

    def _elites(self, states: Array) -> Array:
        elites = self._archive.data()
        _, nearest = cKDTree(self._archive.centroids[elites["index"]]).query(self._scales.states(states))
        return np.asarray(elites["solution"][nearest])
