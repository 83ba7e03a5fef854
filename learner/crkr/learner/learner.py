"""The learner: a deterministic function of its events, without I/O, threads or a clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner.advice import Advice, advise
from crkr.learner.evidence import FitProblem, FitResult, check_fit, fit
from crkr.learner.explanation import explain
from crkr.learner.exploration.draws import draw_ids
from crkr.learner.exploration.outcome_learner import Drift
from crkr.learner.learned_trials import LearnedTrials
from crkr.learner.model import Model
from crkr.learner.model_builder import ModelBuilder
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.history import TrialHistory
from crkr.learner.samples.store import Review
from crkr.learner.selection.anms import Anms
from crkr.learner.selection.eligible_rows import RadiiCache
from crkr.learner.selection.first_come import FirstCome
from crkr.learner.selection.selector import SelectorFactory
from crkr.protocol import (
    Explanation,
    Invalid,
    Prediction,
    Receipt,
    TaskSpec,
    Trial,
    TrialFields,
    Unsupported,
    check_states,
    id_from_wire,
    make_trials,
)
from crkr.protocol.checks import cost_number, finite_array
from crkr.protocol.earlier_python import Unpack

__all__ = ["SELECTORS", "Learner"]

SELECTORS: Final[Mapping[str, SelectorFactory]] = {"anms": Anms, "full": FirstCome.full, "freeze": FirstCome.freeze}

_FEWEST_TO_FIT: Final = 30  # active samples; with fewer, the evidence says little about length-scales


@final
class Learner:
    """Learns one task from trials; its state is a function of the ordered events.

    `report`, `recost`, `remove`, `configure` and `refit` give each event the next log position. A program with a log of
    its own calls the `apply_...` methods with its positions instead; both give the same learner. A call that raises
    changes nothing. Not for use by several threads at once; the models it makes are.

    Args:
        spec: The task; its creation is log position 1.
        selector: Makes another selector than the one the task names.

    Raises:
        Unsupported: The task asks for something that is not available.

    Attributes:
        spec: The specification in force: the one of creation with the changes since.
        version: Log position of the last event applied.
    """

    def __init__(self, spec: TaskSpec, *, selector: SelectorFactory | None = None) -> None:
        if selector is None and spec.selector not in SELECTORS:
            raise Unsupported(
                f"selector {spec.selector!r} is not offered; these are: {', '.join(SELECTORS)}",
                details={"field": "selector"},
            )
        self.spec = self._created = spec
        self.version = 1
        self._asked = 0
        self._trials = LearnedTrials(spec, selector or SELECTORS[spec.selector])
        self._builder = ModelBuilder(spec, self._trials)

    @property
    def model(self) -> Model:
        """The current policy, an immutable snapshot that other threads may use."""
        return self._builder.model

    @property
    def active_ids(self) -> list[UUID]:
        """Ids of the active samples, in the order of the log."""
        return list(self.model.ids)

    @property
    def history(self) -> TrialHistory:
        """All trials so far; other threads may read them."""
        return self._trials.store.history()

    @property
    def advice(self) -> list[Advice]:
        """What limits learning, and what to do about it; [] without a limit."""
        return advise(self.spec, self.history, self.drift, self.eligible, self.model.active)

    @property
    def eligible(self) -> int:
        """Number of trials that may be learned from."""
        return self._trials.eligible

    @property
    def counts(self) -> dict[str, int]:
        """Number of stored trials by kind."""
        return self._trials.store.counts()

    @property
    def drift(self) -> Drift | None:
        """How far outcomes are from their predictions; None where outcomes are not modelled."""
        return None if self._trials.outcomes is None else self._trials.outcomes.drift

    @property
    def refit_due(self) -> bool:
        """Whether `refit_every` eligible trials came since the last fit began, and enough are active to fit to."""
        every = self.spec.refit_every
        return 0 < every <= self._trials.since_fit and self.model.active >= _FEWEST_TO_FIT

    def predict(
        self, states: object, explore: bool = False, trial_ids: Sequence[UUID | bytes] | UUID | bytes | None = None
    ) -> Prediction:
        """Goals for one state (d,) or many (b, d); see `Model.predict`.

        Missing trial ids are derived from the task's name, the version and the number of calls, so that a repeated
        program gets the same ids.
        """
        if trial_ids is None:
            checked = check_states(states, len(self.spec.state))
            key = f"crkr/{self.spec.name}/predict/{self.version}/{self._asked}"
            answer = self.model.answer(checked, explore, draw_ids(key, len(np.atleast_2d(checked))))
        else:
            answer = self.model.predict(states, explore, trial_ids)
        self._asked += 1
        return answer

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        """Stores trials, all or none, and learns from the eligible ones.

        Args:
            answer: The prediction that was tried; or give `state` and `goal`.
            trial: What was tried and its result, see `TrialFields`.

        Raises:
            Invalid: A value that is not allowed.
            Conflict: An id was reported before with other content.
        """
        if trial.get("id") is None and answer is None:
            state = trial.get("state")
            count = len(state) if np.ndim(state) == 2 else 1  # type: ignore[arg-type]  # checked by make_trials
            trial["id"] = draw_ids(f"crkr/{self.spec.name}/report/{self.version}", count)
        trials = make_trials(self.spec, answer, **trial)
        found = self.review(trials)
        seqs = found.seqs(self.version + 1)
        self.apply_trials([seqs[position] for position in found.fresh], [trials[position] for position in found.fresh])
        if self.refit_due:
            self.refit()
        if self.drift is not None and self.drift.due:
            self.apply_restart(self.version + 1)
        return Receipt(len(found.fresh), len(trials) - len(found.fresh), seqs, self.version)

    def review(self, trials: Sequence[Trial]) -> Review:
        """Which of these trials are new, without storing them; raises `Conflict` as `report` would."""
        return self._trials.store.review(trials)

    def recost(self, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Changes the costs of trials; see `apply_recost`."""
        return self.apply_recost(self.version + 1, ids, costs)

    def remove(self, ids: Sequence[UUID | bytes]) -> int:
        """Removes trials from learning; see `apply_remove`."""
        return self.apply_remove(self.version + 1, ids)

    def configure(self, changes: Mapping[str, Any]) -> TaskSpec:
        """Changes settings; see `apply_configure`."""
        return self.apply_configure(self.version + 1, changes)

    def refit(self) -> FitResult:
        """Fits length-scales and signal variance to the active set, and takes them if the evidence improves.

        Raises:
            NoSamples: No sample is active.
        """
        result = fit(self.begin_fit())
        if result.accepted:
            self.apply_fit(self.version + 1, result.lengthscales, result.signal_variance)
        return result

    def begin_fit(self) -> FitProblem:
        """The input of `fit`, as plain data for another process; counts as the fit that was due.

        Raises:
            NoSamples: No sample is active.
        """
        problem = FitProblem.of(self.model, self._created.lengthscales)
        self._trials.since_fit = 0
        return problem

    def explain(self, state: object, sample_id: UUID | bytes | None = None) -> Explanation:
        """The samples behind the mean at a state (d,), and the status of one sample.

        Raises:
            Invalid: The state has another shape or is not finite; an unknown sample id.
            NoSamples: No sample is active.
        """
        sample = None if sample_id is None else self._trials.explain(id_from_wire(sample_id, "sample_id"))
        return explain(self.model, self.history, state, sample)

    def apply_trials(self, seqs: Sequence[int], trials: Sequence[Trial]) -> None:
        """Applies trials with their log positions, in one step with one new model.

        Raises:
            Invalid: Positions that do not ascend from the version on.
            Conflict: An id that is stored already, or comes twice.
        """
        if not trials:
            return
        self._check_seqs(seqs, len(trials))
        self._advance(seqs[-1], changed=self._trials.append(seqs, trials))

    def apply_columns(self, columns: TrialColumns) -> None:
        """Applies many trials within `bulk`, ten times faster than `apply_trials`.

        Raises:
            Invalid: Positions that do not ascend from the version on; outside of `bulk`.
            Conflict: An id that is stored already, or comes twice; the learner is then unusable.
        """
        if not self._trials.deferred:
            raise Invalid("columns are applied in bulk only; use apply_trials")
        if len(columns) == 0:
            return
        if (np.diff(columns.seqs, prepend=self.version) <= 0).any():
            raise Invalid(f"seqs must ascend from above {self.version}; got {columns.seqs[:5].tolist()}")
        self._trials.extend(columns)
        self.version = int(columns.seqs[-1])

    def apply_recost(self, seq: int, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Applies new costs of trials at log position `seq`; returns how many changed.

        Raises:
            Invalid: An unknown or repeated id, a cost outside [0, 1], not one cost an id.
        """
        rows = self._rows_of(seq, ids)
        checked = finite_array(costs, "costs", (len(rows),)).tolist()
        changed = self._trials.recost(rows, [cost_number(cost, "cost") for cost in checked])
        self._advance(seq, changed=any(map(self._builder.holds, changed)))
        return len(changed)

    def apply_remove(self, seq: int, ids: Sequence[UUID | bytes]) -> int:
        """Removes trials from learning at log position `seq`; returns how many were not removed before.

        Raises:
            Invalid: An unknown or repeated id.
        """
        rows = [row for row in self._rows_of(seq, ids) if not self._trials.store.removed[row]]
        self._advance(seq, changed=self._trials.remove(rows))
        return len(rows)

    def apply_amend(self, seq: int, ids: Sequence[UUID | bytes], values: Sequence[Mapping[str, Any]]) -> int:
        """Amends trials at log position `seq`; returns their number.

        `values` has each trial's new `cost`, `success`, `learn`, `kind`, `outcome` and `removed`.

        Raises:
            Invalid: An unknown or repeated id.
        """
        rows = self._rows_of(seq, ids)
        self._trials.amend(np.array(rows, dtype=np.int64), values)
        self._advance(seq, changed=True)
        return len(rows)

    def apply_configure(self, seq: int, changes: Mapping[str, Any]) -> TaskSpec:
        """Applies new settings at log position `seq`; fitted numbers stay unless given. Returns the specification.

        Raises:
            Invalid: A field that may not change, or a bad value; see `TaskSpec.with_changes`.
        """
        spec = self.spec.with_changes(changes)
        self._check_seqs([seq], 1)
        self.spec = spec
        self._builder.configure(spec, changes)
        self._trials.configure(spec)
        self._advance(seq, changed=True)
        return spec

    def apply_rename(self, seq: int, name: str) -> None:
        """Renames the task at log position `seq`; changes nothing else."""
        self._check_seqs([seq], 1)
        self.spec = replace(self.spec, name=name)
        self._advance(seq)

    def apply_fit(self, seq: int, lengthscales: object, signal_variance: object) -> None:
        """Applies fitted hyper-parameters at log position `seq`; the selection's length-scales stay.

        Raises:
            Invalid: Numbers that are not positive, or not d of them.
        """
        fitted, variance = check_fit(self.spec, lengthscales, signal_variance)
        self._check_seqs([seq], 1)
        self._builder.set_kernel(self.spec, fitted, variance)
        self._trials.since_fit = 0
        self._advance(seq, changed=True)

    def apply_restart(self, seq: int) -> None:
        """Restarts the outcome model from the newest trials at log position `seq`, after a change of the robot."""
        self._check_seqs([seq], 1)
        self._trials.restart(seq)
        self._advance(seq)

    @contextmanager
    def bulk(self, cache: RadiiCache | None = None) -> Iterator[None]:
        """Context in which events are only recorded; the active set and the model are computed once, at its end.

        Args:
            cache: Radii at the log position where the block ends; without them, computing them takes about n log n.
                Radii of another position are ignored.
        """
        self._trials.deferred = True
        try:
            yield
        finally:
            self._trials.rebuild(cache if cache is not None and cache.version == self.version else None)
            self._advance(self.version, changed=True)

    def radii(self) -> RadiiCache | None:
        """The cache that makes the next `bulk` quick, if the selector has one."""
        return self._trials.selection.cache(self.version)

    def _advance(self, seq: int, *, changed: bool = False) -> None:
        """Completes a log position and makes its model."""
        self.version = seq
        if not self._trials.deferred:
            self._builder.update(self.spec, seq, changed=changed)

    def _rows_of(self, seq: int, ids: Sequence[UUID | bytes]) -> list[int]:
        checked = [id_from_wire(value, "ids") for value in ids]
        if len(set(checked)) != len(checked):
            raise Invalid("ids must differ; one comes twice")
        rows = self._trials.store.rows_of(checked)
        self._check_seqs([seq], 1)
        return rows

    def _check_seqs(self, seqs: Sequence[int], count: int) -> None:
        ascending = all(later > earlier for earlier, later in zip([self.version, *seqs], seqs, strict=False))
        if len(seqs) != count or not ascending:
            raise Invalid(f"seqs must be {count} ascending numbers above {self.version}; got {list(seqs)[:5]}")
