"""Makes the model of each version from the active rows of a store; reuses unchanged parts."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, final
from uuid import UUID

import numpy as np

from crkr.learner.exploration.explorer import Explorer, GaussianExplorer
from crkr.learner.exploration.success import SuccessRate
from crkr.learner.kernel import Kernel
from crkr.learner.kernel_matrix import KernelMatrix
from crkr.learner.learned_trials import LearnedTrials
from crkr.learner.model import Model
from crkr.learner.parameters import Parameters
from crkr.learner.samples.history import TrialHistory
from crkr.protocol import Array, TaskSpec
from crkr.protocol.specification.limits import MOST_RECENT

__all__ = ["ModelBuilder"]


@final
class ModelBuilder:
    """Makes a learner's models.

    Args:
        spec: The task as created.
        trials: What is learned from.

    Attributes:
        model: The newest model.
        kernel: The covariance in force: the specification's, or one that was fitted.
    """

    def __init__(self, spec: TaskSpec, trials: LearnedTrials) -> None:
        self.kernel = Kernel(spec.centres, spec.lengthscales, spec.kernel.signal_variance, spec.kernel.linear_weight)
        self._trials, self._store = trials, trials.store
        self._gaussian = GaussianExplorer.of(spec)
        self._matrix = KernelMatrix()
        self._rows = trials.selection.active
        self._ids: dict[int, UUID] = {}  # of the active rows
        self._parameters = Parameters.create(spec, self.kernel, self._prior(spec))
        self.model = self._fitted(1, None)

    def holds(self, row: int) -> bool:
        """Whether the newest model uses a row."""
        return row in self._ids

    def set_kernel(self, spec: TaskSpec, lengthscales: Array, variance: float) -> None:
        """Changes the covariance of later models."""
        self.kernel = Kernel(self.kernel.centre, lengthscales, variance, spec.kernel.linear_weight)

    def configure(self, spec: TaskSpec, changes: Mapping[str, Any]) -> None:
        """Applies changed settings; fitted numbers stay unless given."""
        if "kernel" in changes:
            given = "signal_variance" in changes["kernel"]
            variance = spec.kernel.signal_variance if given else self.kernel.signal_variance
            self.set_kernel(spec, self.kernel.lengthscales, variance)

    def update(self, spec: TaskSpec, version: int, *, changed: bool) -> None:
        """Makes the model of a version; recomputes it only if samples or settings changed.

        Args:
            spec: The specification in force.
            version: Log position.
            changed: Whether settings, costs of active rows or demonstrations changed.
        """
        if changed:
            self._parameters = Parameters.create(spec, self.kernel, self._prior(spec))
        if changed or self._trials.selection.active is not self._rows:
            self._rows = self._trials.selection.active
            self.model = self._fitted(version, self.model)
        else:
            self.model = self.model.at_version(version, self._explorer, self._trials.tried, self._rate())

    @property
    def _explorer(self) -> Explorer:
        return self._gaussian if self._trials.outcomes is None else self._trials.outcomes.explorer

    def _fitted(self, version: int, previous: Model | None) -> Model:
        rows = self._rows.tolist()
        new = [row for row in rows if row not in self._ids]
        self._ids.update(zip(new, self._store.ids(np.array(new, dtype=np.int64)), strict=True))
        self._ids = {row: self._ids[row] for row in rows}
        return Model.create(
            version,
            self._parameters,
            list(self._ids.values()),
            self._store.states[self._rows],
            self._store.goals[self._rows],
            self._store.costs[self._rows],
            previous,
            self._explorer,
            partial(self._matrix.of, self._rows),
            self._trials.tried,
            self._rate(),
        )

    def _rate(self) -> SuccessRate | None:
        """The success rate of the newest trials; None where outcomes predict it."""
        if self._trials.outcomes is not None:
            return None
        history = self._store.history()
        return SuccessRate(partial(_newest, history), self.kernel) if history.any_tried else None

    def _prior(self, spec: TaskSpec) -> Array:
        rows = self._store.demonstrations()
        if spec.prior_mean == "zero":
            return np.zeros(len(spec.goal))
        if not len(rows):
            low, high = spec.bounds
            return np.asarray(low / 2 + high / 2)
        return np.asarray(self._store.goals[rows].mean(axis=0))


def _newest(history: TrialHistory) -> tuple[Array, Array]:
    """States of the newest trials, executed or refused, and 1 for each success, else 0."""
    rows = history.newest_tried(MOST_RECENT)
    return history.states[rows], history.successes(rows).astype(float)
