"""The outcome model as trials come and go: it updates the index and makes the explorer of the next model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, final

import numpy as np

from crkr.learner.exploration.outcome_explorer import OutcomeExplorer
from crkr.learner.exploration.outcome_index import ObservedTrials, OutcomeIndex
from crkr.learner.exploration.outcome_scales import OutcomeScales
from crkr.learner.exploration.prequential import (
    LOOKED_BACK,
    Calibration,
    DeferredCalibration,
    PrequentialRecord,
)
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import TaskSpec

__all__ = ["Drift", "OutcomeLearner"]

_KEPT_AT_DRIFT: Final = 3  # trials that show the change; older ones belong to the robot before


@final
@dataclass(frozen=True, slots=True)
class Drift:
    """Drift: whether the robot has changed since the outcome model was learned.

    Attributes:
        restarts: Number of restarts of the outcome model.
        last_seq: Log position of the last restart; None without one.
        score: CUSUM of the squared standardised residuals; above 20 the model is restarted.
        due: Whether a restart is due.
    """

    restarts: int
    last_seq: int | None
    score: float
    due: bool


@final
class OutcomeLearner:
    """Keeps the explorer up to date with the store's trials.

    Args:
        spec: The task as created.
        store: The trials.

    Attributes:
        explorer: The current one; a new object whenever its trials change.
    """

    def __init__(self, spec: TaskSpec, store: SampleStore) -> None:
        self._store, self._settings, self._scales = store, spec.exploration, OutcomeScales.of(spec)
        self._index = OutcomeIndex(self._scales, store)
        self._filling = spec.start.count
        self._record = PrequentialRecord(self._settings, self._scales, self._filling)
        self._deferred: DeferredCalibration | None = None  # what gives the record
        self._restarts = 0
        self._last_restart: int | None = None
        self.explorer = OutcomeExplorer.of(spec, self._scales, self._index.snapshot())

    @property
    def drift(self) -> Drift:
        """How far the newest outcomes are from their predictions."""
        if self._deferred is not None:
            return Drift(self._restarts, self._last_restart, 0.0, due=False)
        record = self._record
        return Drift(self._restarts, self._last_restart, record.drift_score, self._settings.drift and record.drifted)

    def extend(self, rows: Indices) -> None:
        """Learn from new rows of the store."""
        new = len(self._index.usable(rows))
        if not new:
            return
        before = self._index.snapshot()
        self._index.extend(rows)
        if self._deferred is not None:
            self._record, self._deferred = self._deferred.record(), None
        self._record.extend(self._steps(new, before))
        self._renew(self._record.calibration)

    def remove(self, rows: Sequence[int]) -> None:
        """Start again without rows that were removed from learning."""
        if any(self._index.holds(row) for row in rows):
            self.rebuild()

    def rebuild(self) -> None:
        """Start again from the store. Predictions for the newest trials are computed when they are needed."""
        self._index.rebuild()
        usable = self._index.usable(np.arange(len(self._store)))
        tried = usable[~self._store.demonstrated(usable)]
        looked_back = min(LOOKED_BACK, len(tried))
        first = int(np.searchsorted(usable, tried[-looked_back])) if looked_back else len(usable)
        steps = self._steps(len(usable) - first)
        self._deferred = DeferredCalibration(
            self._settings, self._scales, self._filling, len(tried) - looked_back, steps
        )
        self._renew(self._deferred)

    def restart(self, seq: int, *, rebuild: bool) -> None:
        """Restart from the newest trials after a change of the robot; its former behaviour is the prior.

        Args:
            seq: Log position of the event.
            rebuild: Rebuild the model; False if `rebuild` will be called.
        """
        self._index.restart(_KEPT_AT_DRIFT)
        self._restarts, self._last_restart, self._filling = self._restarts + 1, seq, 0
        if rebuild:
            self.rebuild()

    def _renew(self, calibration: Calibration | DeferredCalibration) -> None:
        changed = self._restarts > 0
        self.explorer = self.explorer.with_trials(self._index.snapshot(), calibration, changed=changed)

    def _steps(self, count: int, first: ObservedTrials | None = None) -> list[tuple[ObservedTrials, ObservedTrials]]:
        """The snapshots before and after each of the newest trials; `first` is the one before all of them."""
        if not count:
            return []
        start, end = len(self._index) - count, len(self._index)
        between = (self._index.before(position) for position in range(start + 1, end))
        return list(pairwise([first or self._index.before(start), *between, self._index.snapshot()]))
