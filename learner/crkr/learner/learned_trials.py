"""All trials of a task, with the selection and the outcome model that follow them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final
from uuid import UUID

import numpy as np

from crkr.learner.exploration.outcome_learner import OutcomeLearner
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.eligible_rows import RadiiCache, Selection
from crkr.learner.selection.selector import SelectorFactory
from crkr.protocol import Conflict, SampleExplanation, TaskSpec, Trial

__all__ = ["LearnedTrials"]


@final
class LearnedTrials:
    """The trials of a learner. Arguments are checked already; rows are the store's.

    Args:
        spec: The task as created.
        selector: Makes the selector of active rows.

    Attributes:
        store: All trials.
        selection: Which of them are active.
        outcomes: The outcome model; None where outcomes are not modelled.
        deferred: Whether to store and count only; `rebuild` does the rest.
        eligible: Number of trials that may be learned from; kept, as a recount takes longer than a step.
        since_fit: Eligible trials since hyper-parameters were fitted.
        tried: Number of trials, refused ones too, without demonstrations and evaluations.
    """

    def __init__(self, spec: TaskSpec, selector: SelectorFactory) -> None:
        guided = spec.exploration.type == "outcome"
        self.store = SampleStore(len(spec.state), len(spec.goal), len(spec.outcome) if guided else 0)
        self.selection = Selection(spec, self.store, selector)
        self.outcomes = OutcomeLearner(spec, self.store) if guided else None
        self.deferred = False
        self.eligible = self.since_fit = self.tried = 0
        self._learn_from, self._budget = spec.learn_from, spec.budget

    def append(self, seqs: Sequence[int], trials: Sequence[Trial]) -> bool:
        """Stores trials; returns whether one is a demonstration, which the prior mean depends on.

        Raises:
            Conflict: An id that is stored already, or comes twice.
        """
        known = [trial.id for trial in trials if self.store.find(trial.id) is not None]
        if known or len({trial.id for trial in trials}) != len(trials):
            raise Conflict(f"trials to apply must be new; known already: {known[:3] or 'an id comes twice'}")
        rows = [self.store.append(seq, trial) for seq, trial in zip(seqs, trials, strict=True)]
        eligible = [row for row, one in zip(rows, trials, strict=True) if one.eligible(self._learn_from)]
        self._count(len(eligible), sum(trial.kind in ("trial", "failed") for trial in trials))
        if not self.deferred:
            self.selection.extend(np.array(eligible, dtype=np.int64))
            if self.outcomes is not None:
                self.outcomes.extend(np.array(rows))
        return any(trial.kind == "demonstration" for trial in trials)

    def extend(self, columns: TrialColumns) -> None:
        """Stores many trials while learning is deferred.

        Raises:
            Conflict: An id that is stored already, or comes twice; the trials are then unusable.
        """
        first = len(self.store)
        known = self.store.extend(columns)
        if known is not None:
            raise Conflict(f"trials to apply must be new; log position {int(self.store.seqs[known])} repeats an id")
        rows = np.arange(first, len(self.store))
        self._count(len(self._eligible_of(rows)), self.store.count_tried(rows))

    def recost(self, rows: Sequence[int], costs: Sequence[float]) -> list[int]:
        """Changes the costs of rows; returns those whose cost changed."""
        changed = [(row, cost) for row, cost in zip(rows, costs, strict=True) if self.store.costs[row] != cost]
        for row, cost in changed:
            self.store.recost(row, cost)
        if not self.deferred:
            self.selection.recost([row for row, _ in changed if not self.store.removed[row]])
        return [row for row, _ in changed]

    def remove(self, rows: Sequence[int]) -> bool:
        """Removes rows from learning; returns whether one is a demonstration."""
        indices = np.array(rows, dtype=np.int64)
        self.eligible -= len(self._eligible_of(indices))
        for row in rows:
            self.store.remove(row)
        if not self.deferred:
            self.selection.remove(rows)
            if self.outcomes is not None:
                self.outcomes.remove(rows)
        return self._demonstrated(indices)

    def amend(self, rows: Indices, values: Sequence[Mapping[str, Any]]) -> None:
        """Amends rows, as `SampleStore.amend` does for each."""
        before, tried = self._eligible_of(rows), self.store.count_tried(rows)
        for row, each in zip(rows.tolist(), values, strict=True):
            self.store.amend(row, each)
        now = self._eligible_of(rows)
        self.tried += self.store.count_tried(rows) - tried
        self.eligible += len(now) - len(before)
        if self.deferred:
            return
        if np.isin(now, before).all():
            self.selection.remove(np.setdiff1d(before, now).tolist())
            self.selection.recost(now.tolist())
        else:  # some may be older than the present ones
            self.selection.rebuild(self._all_eligible())
        if self.outcomes is not None:
            self.outcomes.rebuild()

    def configure(self, spec: TaskSpec) -> None:
        """Applies changed settings of a specification."""
        budget, self._budget = self._budget, spec.budget
        learn_from, self._learn_from = self._learn_from, spec.learn_from
        if not self.deferred and spec.budget != budget:
            self.selection.set_budget(spec.budget)
        if spec.learn_from != learn_from:
            eligible = self._all_eligible()
            self.eligible = len(eligible)
            if not self.deferred:
                self.selection.rebuild(eligible)

    def restart(self, seq: int) -> None:
        """Restarts the outcome model from the newest trials, at log position `seq`."""
        if self.outcomes is not None:
            self.outcomes.restart(seq, rebuild=not self.deferred)

    def rebuild(self, cache: RadiiCache | None) -> None:
        """Rebuilds selection and outcome model; matching radii make it quick."""
        self.deferred = False
        self.selection.set_budget(self._budget)
        self.selection.rebuild(self._all_eligible(), cache)
        if self.outcomes is not None:
            self.outcomes.rebuild()

    def explain(self, sample: UUID) -> SampleExplanation:
        """Status of one trial.

        Raises:
            Invalid: An unknown id.
        """
        [row] = self.store.rows_of([sample])
        suppressor, radius = self.selection.standing(row)
        return SampleExplanation(
            id=sample,
            active=bool((self.selection.active == row).any()),
            eligible=bool(len(self._eligible_of(np.array([row])))),
            suppressor=None if suppressor is None else self.store.ids(np.array([suppressor]))[0],
            radius=radius,
        )

    def _count(self, eligible: int, tried: int) -> None:
        self.eligible += eligible
        self.since_fit += eligible
        self.tried += tried

    def _demonstrated(self, rows: Indices) -> bool:
        return bool(self.store.demonstrated(rows).any())

    def _eligible_of(self, rows: Indices) -> Indices:
        return rows[self.store.eligible(rows, self._learn_from)]

    def _all_eligible(self) -> Indices:
        return self._eligible_of(np.arange(len(self.store)))
