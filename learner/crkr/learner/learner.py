"""The learner: a deterministic function of what it was told, without I/O, threads or a clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner.advice import Advice, advise
from crkr.learner.evidence import FitProblem, FitResult, fit
from crkr.learner.explanation import explain
from crkr.learner.exploration.draws import draw_ids
from crkr.learner.exploration.outcome_learner import Drift
from crkr.learner.knowledge import Knowledge
from crkr.learner.model import Model
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.history import TrialHistory
from crkr.learner.samples.report_review import Review, review
from crkr.learner.selection.anms import Anms
from crkr.learner.selection.eligible_rows import RadiiCache
from crkr.learner.selection.first_come import FirstCome
from crkr.learner.selection.selector import SelectorFactory
from crkr.protocol import (
    Explanation,
    NoSamples,
    Prediction,
    Receipt,
    SampleExplanation,
    TaskSpec,
    Trial,
    TrialFields,
    Unsupported,
    check_states,
    id_from_wire,
    make_trials,
)
from crkr.protocol.earlier_python import Unpack

__all__ = ["SELECTORS", "Learner"]

SELECTORS: Final[Mapping[str, SelectorFactory]] = {"anms": Anms, "full": FirstCome.full, "freeze": FirstCome.freeze}

_FEWEST_TO_FIT: Final = 30  # active samples, below which the evidence says little about length-scales


@final
class Learner:
    """Learns one task from trials; what it knows is a function of the events it was given, in their order.

    `report`, `recost`, `remove`, `configure` and `refit` give each event the next log position. A program with a log of
    its own calls the `apply_...` methods with its positions instead; both give the same learner. A call that raises
    changes nothing. Not for use by several threads at once; the models it makes are.

    Args:
        spec: The task; its creation is log position 1.
        selector: Makes another selector than the one the task names.

    Raises:
        Unsupported: The task asks for something that is not built here.
    """

    def __init__(self, spec: TaskSpec, *, selector: SelectorFactory | None = None) -> None:
        if selector is None and spec.selector not in SELECTORS:
            raise Unsupported(
                f"selector {spec.selector!r} is not offered; these are: {', '.join(SELECTORS)}",
                details={"field": "selector"},
            )
        self._told = Knowledge(spec, selector or SELECTORS[spec.selector])
        self._asked = 0

    @property
    def spec(self) -> TaskSpec:
        """The specification in force: the one of creation with the changes since."""
        return self._told.spec

    @property
    def version(self) -> int:
        """Log position of the last event applied."""
        return self._told.version

    @property
    def model(self) -> Model:
        """The present policy, an immutable snapshot that other threads may use."""
        return self._told.model

    @property
    def active_ids(self) -> list[UUID]:
        """Ids of the active samples, in the order of the log."""
        return list(self.model.ids)

    @property
    def history(self) -> TrialHistory:
        """All trials of this moment, which other threads may read."""
        return self._told.store.history()

    @property
    def advice(self) -> list[Advice]:
        """What limits learning, and what to do about it; [] where nothing does."""
        return advise(self.spec, self.history, self.drift, self.eligible, self.model.active)

    @property
    def counts(self) -> dict[str, int]:
        """How many trials of each kind are stored."""
        return self._told.store.counts()

    @property
    def eligible(self) -> int:
        """How many trials may be learned from."""
        return self._told.eligible_count

    def predict(
        self, states: object, explore: bool = False, trial_ids: Sequence[UUID | bytes] | UUID | bytes | None = None
    ) -> Prediction:
        """Goals for one state (d,) or many (b, d); see `Model.predict`.

        Absent trial ids are derived from the task's name, the version and how often this learner was asked, so that a
        program that repeats its calls gets the same ids.
        """
        if trial_ids is None:
            checked = check_states(states, len(self.spec.state))
            count = 1 if checked.ndim == 1 else len(checked)
            ids = draw_ids(f"crkr/{self.spec.name}/predict/{self.version}/{self._asked}", count)
            answer = self.model.answer(checked, explore, ids)
        else:
            answer = self.model.predict(states, explore, trial_ids)
        self._asked += 1
        return answer

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        """Stores trials, all or none, and learns from the eligible ones.

        Args:
            answer: The prediction that was tried; or give `state` and `goal`.
            trial: What was done and how it went, see `TrialFields`.

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
        return review(self._told.store, trials)

    def recost(self, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Changes the costs of trials that turned out better or worse; returns how many changed.

        Raises:
            Invalid: An unknown or repeated id, a cost outside [0, 1].
        """
        return self.apply_recost(self.version + 1, ids, costs)

    def remove(self, ids: Sequence[UUID | bytes]) -> int:
        """Takes trials out of learning for good; returns how many were still in.

        Raises:
            Invalid: An unknown or repeated id.
        """
        return self.apply_remove(self.version + 1, ids)

    def configure(self, changes: Mapping[str, Any]) -> TaskSpec:
        """Changes settings; returns the specification in force. Raises `Invalid` as `TaskSpec.with_changes` does."""
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

    @property
    def refit_due(self) -> bool:
        """Whether `refit_every` eligible trials came since the last fit began, and enough are active to fit to."""
        every = self.spec.refit_every
        return 0 < every <= self._told.since_fit and self.model.active >= _FEWEST_TO_FIT

    def begin_fit(self) -> FitProblem:
        """What `fit` needs, as plain data that another process can work on; counts as the fit that was due.

        Raises:
            NoSamples: No sample is active.
        """
        if self.model.regression is None:
            raise NoSamples(f"task {self.spec.name!r} has no active sample to fit to")
        self._told.since_fit = 0
        return FitProblem.of(self.model, self._told.created.lengthscales)

    def explain(self, state: object, sample_id: UUID | bytes | None = None) -> Explanation:
        """The samples behind the mean at a state (d,), and where one sample stands.

        Raises:
            Invalid: The state has another shape or is not finite; an unknown sample id.
            NoSamples: No sample is active.
        """
        sample = None
        if sample_id is not None:
            [row] = self._told.store.rows_of([id_from_wire(sample_id, "sample_id")])
            suppressor, radius = self._told.selection.standing(row)
            sample = SampleExplanation(
                id=self._told.store.ids(np.array([row]))[0],
                active=bool((self._told.selection.active == row).any()),
                eligible=bool(self._told.store.eligible(np.array([row]), self.spec.learn_from)[0]),
                suppressor=None if suppressor is None else self._told.store.ids(np.array([suppressor]))[0],
                radius=radius,
            )
        return explain(self.model, self.history, state, sample)

    def apply_trials(self, seqs: Sequence[int], trials: Sequence[Trial]) -> None:
        """Applies trials with their log positions, in one step with one new model.

        Raises:
            Invalid: Positions that do not ascend from the version on.
            Conflict: An id that is stored already, or comes twice.
        """
        self._told.apply_trials(seqs, trials)

    def apply_columns(self, columns: TrialColumns) -> None:
        """Applies many trials within `bulk`, ten times quicker than `apply_trials`.

        Raises:
            Invalid: Positions that do not ascend from the version on; outside of `bulk`.
            Conflict: An id that is stored already, or comes twice; the learner is of no use then.
        """
        self._told.apply_columns(columns)

    def apply_recost(self, seq: int, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Applies a change of costs at log position `seq`; see `recost`."""
        return self._told.apply_recost(seq, ids, costs)

    def apply_remove(self, seq: int, ids: Sequence[UUID | bytes]) -> int:
        """Applies a removal at log position `seq`; see `remove`."""
        return self._told.apply_remove(seq, ids)

    def apply_amend(self, seq: int, ids: Sequence[UUID | bytes], values: Sequence[Mapping[str, Any]]) -> int:
        """Applies other values of trials at log position `seq`; returns how many trials there are.

        Args:
            seq: Log position.
            ids: The trials.
            values: For each its `cost`, `success`, `learn`, `kind`, `outcome` and `removed` from now on.

        Raises:
            Invalid: An unknown or repeated id.
        """
        return self._told.apply_amend(seq, ids, values)

    def apply_configure(self, seq: int, changes: Mapping[str, Any]) -> TaskSpec:
        """Applies new settings at log position `seq`; see `configure`. Fitted numbers stay where none are given."""
        return self._told.apply_configure(seq, changes)

    def apply_rename(self, seq: int, name: str) -> None:
        """Applies another name of the task at log position `seq`."""
        self._told.apply_rename(seq, name)

    def apply_fit(self, seq: int, lengthscales: object, signal_variance: object) -> None:
        """Applies fitted hyper-parameters at log position `seq`; the selection's length-scales stay.

        Raises:
            Invalid: Numbers that are not positive, or not d of them.
        """
        self._told.apply_fit(seq, lengthscales, signal_variance)

    def apply_restart(self, seq: int) -> None:
        """Applies a restart of the outcome model at log position `seq`, as after a change of the robot."""
        self._told.apply_restart(seq)

    @property
    def drift(self) -> Drift | None:
        """How far outcomes are from what was expected of them; None where no outcome is modelled."""
        return self._told.drift

    def bulk(self, cache: RadiiCache | None = None) -> AbstractContextManager[None]:
        """A block in which events are only taken note of; the active set and the model are made once, at its end.

        Args:
            cache: Radii at the log position where the block ends; without them they are searched for, in about
                n log n. Ones of another position are ignored.
        """
        return self._told.bulk(cache)

    def radii(self) -> RadiiCache | None:
        """What makes the next `bulk` quick, where the selector has such a thing."""
        return self._told.selection.cache(self.version)
