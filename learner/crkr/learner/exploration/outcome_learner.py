"""The outcome model as trials come and go: the index followed, and an explorer for the next model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.learner.exploration.outcome_explorer import OutcomeExplorer
from crkr.learner.exploration.outcome_index import OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.prequential import PrequentialRecord
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import TaskSpec

__all__ = ["Drift", "OutcomeLearner"]

_LOOKED_BACK: Final = 200  # trials whose expectations are worked out again after a restart
_KEPT_AT_DRIFT: Final = 8  # trials that show the change; older ones are of the robot as it was


@final
@dataclass(frozen=True, slots=True)
class Drift:
    """Whether the robot changes under the outcome model.

    Attributes:
        restarts: How often the outcome model was restarted.
        last_seq: Log position of the last restart; None: there was none.
        score: CUSUM of the squared standardised residuals; above 12 the model is restarted.
        due: Whether it should be restarted now.
    """

    restarts: int
    last_seq: int | None
    score: float
    due: bool


@final
class OutcomeLearner:
    """Keeps the explorer that the store's trials call for.

    Args:
        spec: The task as created.
        store: The trials.

    Attributes:
        explorer: The present one; another object whenever its trials change.
    """

    def __init__(self, spec: TaskSpec, store: SampleStore) -> None:
        scales = OutcomeScales.of(spec)
        self._store, self._watched = store, spec.exploration.drift
        self._index = OutcomeIndex(scales, store)
        self._record = PrequentialRecord(spec.exploration, scales)
        self._restarts = 0
        self._last_restart: int | None = None
        self.explorer = OutcomeExplorer.of(spec, scales, self._index.snapshot())

    @property
    def drift(self) -> Drift:
        """How far the newest trials are from what was expected of them."""
        record = self._record
        return Drift(self._restarts, self._last_restart, record.drift_score, self._watched and record.drifted)

    def extend(self, rows: Indices) -> None:
        """Learn from new rows of the store."""
        self._note(rows)
        self._renew()

    def remove(self, rows: Sequence[int]) -> None:
        """Rows were removed from learning; start again without them."""
        if any(self._index.holds(row) for row in rows):
            self.rebuild()

    def rebuild(self) -> None:
        """Start again from the store."""
        self._record.clear()
        usable = self._index.usable(np.arange(len(self._store)))
        self._index.rebuild(usable[: max(0, len(usable) - _LOOKED_BACK)])
        self._note(usable[max(0, len(usable) - _LOOKED_BACK) :])
        self._renew()

    def restart(self, seq: int, *, rebuild: bool) -> None:
        """Forget all but the newest trials: the robot has changed.

        Args:
            seq: Log position of the event.
            rebuild: Make the model anew; False where `rebuild` will be called.
        """
        usable = self._index.usable(np.arange(len(self._store)))
        self._index.start = int(usable[-_KEPT_AT_DRIFT:][0]) if len(usable) else 0
        self._restarts, self._last_restart = self._restarts + 1, seq
        if rebuild:
            self.rebuild()

    def _note(self, rows: Indices) -> None:
        for row in self._index.usable(rows):
            before = self._index.snapshot()
            self._index.extend(np.array([row]))
            if not self._store.is_demonstration(row):
                self._record.add(before, self._index.snapshot(), self._store.succeeded(row))

    def _renew(self) -> None:
        self.explorer = self.explorer.with_trials(self._index.snapshot(), self._record.curve, self._record.spread)
