"""The outcome model as trials come and go: the index followed, and an explorer for the next model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

from crkr.learner.exploration.outcome_explorer import OutcomeExplorer
from crkr.learner.exploration.outcome_index import OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import TaskSpec

__all__ = ["OutcomeLearning"]


@final
class OutcomeLearning:
    """Keeps the explorer that the store's trials call for.

    Args:
        spec: The task as created.
        store: The trials.

    Attributes:
        explorer: The present one; another object whenever its trials change.
    """

    def __init__(self, spec: TaskSpec, store: SampleStore) -> None:
        scales = OutcomeScales.of(spec)
        self._index = OutcomeIndex(scales, store)
        self.explorer = OutcomeExplorer.of(spec, scales, self._index.snapshot())

    def extend(self, rows: Indices) -> None:
        """Takes note of new rows of the store."""
        if self._index.extend(rows):
            self._renew()

    def remove(self, rows: Sequence[int]) -> None:
        """Takes note of rows that were removed from learning."""
        if any(self._index.holds(row) for row in rows):
            self.rebuild()

    def rebuild(self) -> None:
        """Starts again from the store."""
        self._index.rebuild()
        self._renew()

    def _renew(self) -> None:
        self.explorer = self.explorer.with_trials(self._index.snapshot())
