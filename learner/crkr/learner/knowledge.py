"""What a task's log says so far: samples, settings, active set and the model made of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, final
from uuid import UUID

import numpy as np

from crkr.learner.exploration.explorer import Explorer, GaussianExplorer
from crkr.learner.exploration.outcome_learner import Drift, OutcomeLearner
from crkr.learner.exploration.success import SuccessRate
from crkr.learner.kernel import Kernel
from crkr.learner.kernel_matrix import KernelMatrix
from crkr.learner.model import Model
from crkr.learner.parameters import Parameters
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.store import SampleStore
from crkr.learner.selection.anms_batch import Indices
from crkr.learner.selection.eligible_rows import RadiiCache, Selection
from crkr.learner.selection.selector import SelectorFactory
from crkr.protocol import Array, Conflict, Invalid, TaskSpec, Trial, id_from_wire
from crkr.protocol.checks import cost_number, finite_array, number
from crkr.protocol.messages.sizes import MOST_RECENT

__all__ = ["Knowledge", "check_fit"]


def check_fit(spec: TaskSpec, lengthscales: object, signal_variance: object) -> tuple[Array, float]:
    """Numbers of a fit, as a task of this specification takes them; what is logged must pass first.

    Raises:
        Invalid: Numbers that are not finite and positive, or not d of them.
    """
    fitted = finite_array(lengthscales, "lengthscales", (len(spec.state),))
    variance = number(signal_variance, "signal_variance", above=0.0)
    if (fitted <= 0).any():
        raise Invalid(f"lengthscales must be positive; got {fitted.tolist()}")
    return fitted, variance


@final
class Knowledge:
    """Applies the events of a log, each with its position; the same events give the same knowledge.

    Every method checks all of its arguments before it changes anything.

    Args:
        spec: The task; its creation is log position 1.
        selector: Makes the rule that picks the active samples.

    Attributes:
        created: The task as created.
        spec: The specification in force.
        version: Log position of the last event applied.
        store: All trials.
        selection: Which of them are active.
        model: The policy made of the active ones.
        eligible_count: How many trials may be learned from; kept, as counting them anew takes longer than a step.
        since_fit: Eligible trials since hyper-parameters were fitted.
        tried: Trials reported, refused ones and misses too, demonstrations and judged ones aside.
    """

    def __init__(self, spec: TaskSpec, selector: SelectorFactory) -> None:
        self.created = self.spec = spec
        self.version = 1
        guided = spec.exploration.type == "outcome"
        self.store = SampleStore(len(spec.state), len(spec.goal), len(spec.outcome) if guided else 0)
        self.selection = Selection(spec, self.store, selector)
        self.eligible_count = self.since_fit = self.tried = 0
        self._kernel = Kernel(spec.centres, spec.lengthscales, spec.kernel.signal_variance, spec.kernel.linear_weight)
        self._deferred = False
        self._names: dict[int, UUID] = {}  # of the active rows
        self._rows = self.selection.active
        self._parameters = Parameters.create(spec, self._kernel, self._prior())
        self._guided = OutcomeLearner(spec, self.store) if guided else None
        self._gaussian = GaussianExplorer.of(spec)
        self._matrix = KernelMatrix()
        self.model = self._fitted(None)

    def apply_trials(self, seqs: Sequence[int], trials: Sequence[Trial]) -> None:
        """Stores new trials and learns from the eligible ones, with one new model.

        Raises:
            Invalid: Positions that do not ascend from the version on.
            Conflict: An id that is stored already, or comes twice.
        """
        if not trials:
            return
        self._check_seqs(seqs, len(trials))
        known = [trial.id for trial in trials if self.store.find(trial.id) is not None]
        if known or len({trial.id for trial in trials}) != len(trials):
            raise Conflict(f"trials to apply must be new; known already: {known[:3] or 'an id comes twice'}")
        rows = np.array([self.store.append(seq, trial) for seq, trial in zip(seqs, trials, strict=True)])
        self.version = seqs[-1]
        eligible = rows[self.store.eligible(rows, self.spec.learn_from)]
        self._count(len(eligible))
        self.tried += self.store.count_tried(rows)
        if not self._deferred:
            self.selection.extend(eligible)
            if self._guided is not None:
                self._guided.extend(rows)
            self._refresh(any(self.store.is_demonstration(row) for row in rows))

    def apply_columns(self, columns: TrialColumns) -> None:
        """Stores many new trials; only while `bulk` goes on, which learns from them at its end.

        Raises:
            Invalid: Positions that do not ascend from the version on; outside of `bulk`.
            Conflict: An id that is stored already, or comes twice; this knowledge is of no use then.
        """
        if not self._deferred:
            raise Invalid("columns are applied in bulk only; use apply_trials")
        if not len(columns):
            return
        if (np.diff(columns.seqs, prepend=self.version) <= 0).any():
            raise Invalid(f"seqs must ascend from above {self.version}; got {columns.seqs[:5].tolist()}")
        first = len(self.store)
        known = self.store.extend(columns)
        if known is not None:
            raise Conflict(f"trials to apply must be new; log position {int(self.store.seqs[known])} repeats an id")
        rows = np.arange(first, len(self.store))
        self._count(int(np.count_nonzero(self.store.eligible(rows, self.spec.learn_from))))
        self.tried += self.store.count_tried(rows)
        self.version = int(columns.seqs[-1])

    def apply_recost(self, seq: int, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Changes the present costs of trials; returns how many differ now.

        Raises:
            Invalid: An unknown or repeated id, a cost outside [0, 1], not one cost an id.
        """
        rows = self._rows_of(ids)
        checked = finite_array(costs, "costs", (len(rows),))
        values = [cost_number(cost, "cost") for cost in checked.tolist()]
        self._check_seqs([seq], 1)
        changed = [(row, cost) for row, cost in zip(rows, values, strict=True) if self.store.costs[row] != cost]
        for row, cost in changed:
            self.store.recost(row, cost)
        if not self._deferred:
            self.selection.recost([row for row, _ in changed if not self.store.removed[row]])
        self.version = seq
        self._refresh(any(row in self._names for row, _ in changed))
        return len(changed)

    def apply_remove(self, seq: int, ids: Sequence[UUID | bytes]) -> int:
        """Takes trials out of learning for good; returns how many were still in.

        Raises:
            Invalid: An unknown or repeated id.
        """
        rows = [row for row in self._rows_of(ids) if not self.store.removed[row]]
        self._check_seqs([seq], 1)
        leaving = self.store.eligible(np.array(rows, dtype=np.int64), self.spec.learn_from)
        self.eligible_count -= int(np.count_nonzero(leaving))
        for row in rows:
            self.store.remove(row)
        if not self._deferred:
            self.selection.remove(rows)
            if self._guided is not None:
                self._guided.remove(rows)
        self.version = seq
        self._refresh(any(self.store.is_demonstration(row) for row in rows))
        return len(rows)

    def apply_amend(self, seq: int, ids: Sequence[UUID | bytes], values: Sequence[Mapping[str, Any]]) -> int:
        """Changes what trials are said to be; see `Learner.apply_amend`."""
        rows = self._rows_of(ids)
        self._check_seqs([seq], 1)
        indices = np.array(rows, dtype=np.int64)
        eligible, tried = self.store.eligible(indices, self.spec.learn_from), self.store.count_tried(indices)
        for row, each in zip(rows, values, strict=True):
            self.store.amend(row, each)
        self.tried += self.store.count_tried(indices) - tried
        now = self.store.eligible(indices, self.spec.learn_from)
        self.eligible_count += int(np.count_nonzero(now)) - int(np.count_nonzero(eligible))
        if not self._deferred:
            if (now & ~eligible).any():  # they are older than others, and take their places among them
                self.selection.rebuild(self.eligible())
            else:
                self.selection.remove(indices[eligible & ~now].tolist())
                self.selection.recost(indices[now].tolist())
            if self._guided is not None:
                self._guided.rebuild()
        self.version = seq
        self._refresh(True)
        return len(rows)

    def apply_configure(self, seq: int, changes: Mapping[str, Any]) -> TaskSpec:
        """Changes settings; numbers that were fitted stay unless they are given. Returns the specification in force.

        Raises:
            Invalid: A field that may not change, or a bad value.
        """
        spec = self.spec.with_changes(changes)
        self._check_seqs([seq], 1)
        before, self.spec, self.version = self.spec, spec, seq
        if "kernel" in changes:
            given = "signal_variance" in changes["kernel"]
            variance = spec.kernel.signal_variance if given else self._kernel.signal_variance
            self._set_kernel(self._kernel.lengthscales, variance)
        if not self._deferred and spec.budget != before.budget:
            self.selection.set_budget(spec.budget)
        if spec.learn_from != before.learn_from:
            eligible = self.eligible()
            self.eligible_count = len(eligible)
            if not self._deferred:
                self.selection.rebuild(eligible)
        self._refresh(True)
        return spec

    def apply_rename(self, seq: int, name: str) -> None:
        """Gives the task another name, which changes nothing else."""
        self._check_seqs([seq], 1)
        self.spec, self.version = replace(self.spec, name=name), seq
        self._refresh(False)

    def apply_fit(self, seq: int, lengthscales: object, signal_variance: object) -> None:
        """Changes the kernel; distances between samples stay measured as they were when the task was created.

        Raises:
            Invalid: Numbers that are not positive, or not d of them.
        """
        fitted, variance = check_fit(self.spec, lengthscales, signal_variance)
        self._check_seqs([seq], 1)
        self._set_kernel(fitted, variance)
        self.version, self.since_fit = seq, 0
        self._refresh(True)

    def apply_restart(self, seq: int) -> None:
        """Restarts the outcome model from the newest trials: the robot has changed. The active set stays."""
        self._check_seqs([seq], 1)
        self.version = seq
        if self._guided is not None:
            self._guided.restart(seq, rebuild=not self._deferred)
        self._refresh(False)

    @property
    def drift(self) -> Drift | None:
        """How far outcomes are from what was expected; None where no outcome is modelled."""
        return None if self._guided is None else self._guided.drift

    @contextmanager
    def bulk(self, cache: RadiiCache | None) -> Iterator[None]:
        """Inside, events are only taken note of; the active set and the model are made once, at the end."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False
            fits = cache is not None and cache.version == self.version
            self.selection.set_budget(self.spec.budget)
            self.selection.rebuild(self.eligible(), cache if fits else None)
            if self._guided is not None:
                self._guided.rebuild()
            self._refresh(True)

    def eligible(self) -> Indices:
        """Rows of the trials that may be learned from, ascending."""
        everything = np.arange(len(self.store))
        return everything[self.store.eligible(everything, self.spec.learn_from)]

    def _count(self, eligible: int) -> None:
        self.eligible_count += eligible
        self.since_fit += eligible

    def _rows_of(self, ids: Sequence[UUID | bytes]) -> list[int]:
        checked = [id_from_wire(value, "ids") for value in ids]
        if len(set(checked)) != len(checked):
            raise Invalid("ids must differ; one comes twice")
        return self.store.rows_of(checked)

    def _check_seqs(self, seqs: Sequence[int], count: int) -> None:
        ascending = all(later > earlier for earlier, later in zip([self.version, *seqs], seqs, strict=False))
        if len(seqs) != count or not ascending:
            raise Invalid(f"seqs must be {count} ascending numbers above {self.version}; got {list(seqs)[:5]}")

    def _set_kernel(self, lengthscales: Array, variance: float) -> None:
        self._kernel = Kernel(self._kernel.centre, lengthscales, variance, self.spec.kernel.linear_weight)

    def _refresh(self, changed: bool) -> None:
        """Makes the model of the present version; anew only where its samples or settings changed."""
        if self._deferred:
            return
        if changed:
            self._parameters = Parameters.create(self.spec, self._kernel, self._prior())
        if changed or self.selection.active is not self._rows:
            self._rows = self.selection.active
            self.model = self._fitted(self.model)
        else:
            self.model = self.model.at_version(self.version, self._explorer, self.tried, self._rate())

    @property
    def _explorer(self) -> Explorer:
        return self._gaussian if self._guided is None else self._guided.explorer

    def _rate(self) -> SuccessRate | None:
        """What the newest trials say of success; nothing where outcomes say more."""
        if self._guided is not None:
            return None
        history = self.store.history()
        rows = history.newest_tried(MOST_RECENT)
        if not len(rows):
            return None
        return SuccessRate(history.states[rows], history.successes(rows).astype(float), self._kernel)

    def _prior(self) -> Array:
        rows = self.store.demonstrations()
        if self.spec.prior_mean == "zero":
            return np.zeros(len(self.spec.goal))
        if not len(rows):
            low, high = self.spec.bounds
            return np.asarray(low / 2 + high / 2)
        return np.asarray(self.store.goals[rows].mean(axis=0))

    def _fitted(self, previous: Model | None) -> Model:
        rows = self._rows.tolist()
        new = [row for row in rows if row not in self._names]
        self._names.update(zip(new, self.store.ids(np.array(new, dtype=np.int64)), strict=True))
        self._names = {row: self._names[row] for row in rows}
        samples = (self.store.states[self._rows], self.store.goals[self._rows], self.store.costs[self._rows])
        matrix = partial(self._matrix.of, self._rows)
        return Model.create(
            self.version,
            self._parameters,
            list(self._names.values()),
            *samples,
            previous,
            self._explorer,
            matrix,
            self.tried,
            self._rate(),
        )
