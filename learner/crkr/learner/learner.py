"""The learner: a deterministic function of what it was told, without I/O, threads or a clock."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from crkr.learner.anms import Anms
from crkr.learner.draws import draw_ids
from crkr.learner.evidence import FitProblem, FitResult, fit
from crkr.learner.explain import explain
from crkr.learner.freeze import Freeze
from crkr.learner.full import Full
from crkr.learner.kernel import Kernel
from crkr.learner.model import Model
from crkr.learner.parameters import Parameters
from crkr.learner.review import Review, review
from crkr.learner.selection import RadiiCache, Selection
from crkr.learner.selector import SelectorFactory
from crkr.learner.store import SampleStore
from crkr.protocol import (
    Array,
    Conflict,
    Explanation,
    Invalid,
    NoSamples,
    Prediction,
    Receipt,
    SampleExplanation,
    TaskSpec,
    Trial,
    Unsupported,
    id_from_wire,
    make_trials,
)
from crkr.protocol.checks import finite_array, number

__all__ = ["SELECTORS", "Learner"]

SELECTORS: Final[Mapping[str, SelectorFactory]] = {"anms": Anms, "full": Full, "freeze": Freeze}

_FEWEST_TO_FIT: Final = 30  # active samples, below which the evidence says little about length-scales


@final
class Learner:
    """Learns one task from trials; what it knows is a function of the events it was given, in their order.

    `report`, `recost`, `remove`, `configure` and `refit` give each event the next log position. A program that keeps its
    own log calls the `apply_...` methods with its positions instead; both give the same learner. A call that raises
    changes nothing. Not for use by several threads at once; the models it makes are.

    Args:
        spec: The task; its creation is log position 1.
        selector: Makes another selector than the one the task names.

    Raises:
        Unsupported: The task asks for something that is not built here.
    """

    def __init__(self, spec: TaskSpec, *, selector: SelectorFactory | None = None) -> None:
        if spec.exploration.type != "gaussian":
            raise Unsupported(
                f"exploration.type {spec.exploration.type!r} is not offered by this learner; "
                'set exploration to {"type": "gaussian"}',
                details={"field": "exploration.type"},
            )
        if selector is None and spec.selector not in SELECTORS:
            raise Unsupported(
                f"selector {spec.selector!r} is not offered; these are: {', '.join(SELECTORS)}",
                details={"field": "selector"},
            )
        self._spec, self._version, self._asked = spec, 1, 0
        self._store = SampleStore(len(spec.state), len(spec.goal))
        self._selection = Selection(spec, self._store, selector or SELECTORS[spec.selector])
        self._kernel = Kernel(spec.centres, spec.lengthscales, spec.kernel.signal_variance, spec.kernel.linear_weight)
        self._prior = np.zeros(len(spec.goal))
        self._parameters = Parameters.create(spec, self._kernel, self._prior)
        self._since_fit = 0
        self._deferred = False
        self._names: dict[int, UUID] = {}
        self._rows = self._selection.active
        self._model = self._fitted(None)

    @property
    def spec(self) -> TaskSpec:
        """The specification in force: the one of creation with the changes since."""
        return self._spec

    @property
    def version(self) -> int:
        """Log position of the last event applied."""
        return self._version

    @property
    def model(self) -> Model:
        """The present policy, an immutable snapshot that other threads may use."""
        return self._model

    @property
    def active_ids(self) -> list[UUID]:
        """Ids of the active samples, in the order of the log."""
        return list(self._model.ids)

    @property
    def counts(self) -> dict[str, int]:
        """How many trials of each kind are stored."""
        return self._store.counts()

    @property
    def eligible(self) -> int:
        """How many trials may be learned from."""
        return int(np.count_nonzero(self._store.eligible(self._spec.learn_from)))

    def predict(
        self, states: object, explore: bool = False, trial_ids: Sequence[UUID | bytes] | UUID | bytes | None = None
    ) -> Prediction:
        """Goals for one state (d,) or many (b, d); see `Model.predict`.

        Absent trial ids are derived from the task's name, the version and how often this learner was asked, so that a
        program that repeats its calls gets the same ids.
        """
        if trial_ids is None:
            count = len(states) if np.ndim(states) == 2 else 1  # type: ignore[arg-type]  # checked by the model
            trial_ids = draw_ids(f"crkr/{self._spec.name}/predict/{self._version}/{self._asked}", count)
        answer = self._model.predict(states, explore, trial_ids)
        self._asked += 1
        return answer

    def report(
        self,
        answer: Prediction | None = None,
        *,
        state: object = None,
        goal: object = None,
        cost: object,
        success: object,
        kind: str = "trial",
        id: UUID | bytes | Sequence[UUID | bytes] | None = None,  # noqa: A002 - the protocol's word
        outcome: object = None,
        worker: str | None = None,
        model_version: int | None = None,
        info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    ) -> Receipt:
        """Stores trials, all or none, and learns from the eligible ones; arguments as for `make_trials`.

        Raises:
            Invalid: A value that is not allowed.
            Conflict: An id was reported before with other content.
        """
        if id is None and answer is None:
            count = len(state) if np.ndim(state) == 2 else 1  # type: ignore[arg-type]  # checked by make_trials
            id = draw_ids(f"crkr/{self._spec.name}/report/{self._version}", count)  # noqa: A001
        trials = make_trials(
            self._spec,
            answer,
            state=state,
            goal=goal,
            cost=cost,
            success=success,
            kind=kind,
            id=id,
            outcome=outcome,
            worker=worker,
            model_version=model_version,
            info=info,
        )
        found = self.review(trials)
        seqs = found.seqs(self._version + 1)
        self.apply_trials([seqs[position] for position in found.fresh], [trials[position] for position in found.fresh])
        if self.refit_due:
            self.refit()
        return Receipt(len(found.fresh), len(trials) - len(found.fresh), seqs, self._version)

    def review(self, trials: Sequence[Trial]) -> Review:
        """Which of these trials are new, without storing them; raises `Conflict` as `report` would."""
        return review(self._store, trials)

    def seq_of(self, trial_id: UUID) -> int | None:
        """Log position a trial was stored under, or None."""
        row = self._store.find(trial_id)
        return None if row is None else int(self._store.seqs[row])

    def recost(self, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Changes the costs of trials that turned out better or worse; returns how many changed.

        Raises:
            Invalid: An unknown or repeated id, a cost outside [0, 1].
        """
        return self.apply_recost(self._version + 1, ids, costs)

    def remove(self, ids: Sequence[UUID | bytes]) -> int:
        """Takes trials out of learning for good; returns how many were still in.

        Raises:
            Invalid: An unknown or repeated id.
        """
        return self.apply_remove(self._version + 1, ids)

    def configure(self, changes: Mapping[str, Any]) -> TaskSpec:
        """Changes settings; returns the specification in force. Raises `Invalid` as `TaskSpec.with_changes` does."""
        return self.apply_configure(self._version + 1, changes)

    def refit(self) -> FitResult:
        """Fits length-scales and signal variance to the active set, and takes them if the evidence improves.

        Raises:
            NoSamples: No sample is active.
        """
        result = fit(self.begin_fit())
        if result.accepted:
            self.apply_fit(self._version + 1, result.lengthscales, result.signal_variance)
        return result

    @property
    def refit_due(self) -> bool:
        """Whether `refit_every` eligible trials came since the last fit began, and enough are active to fit to."""
        every = self._spec.refit_every
        return 0 < every <= self._since_fit and self._model.active >= _FEWEST_TO_FIT

    def begin_fit(self) -> FitProblem:
        """What `fit` needs, as plain data that another process can work on; counts as the fit that was due.

        Raises:
            NoSamples: No sample is active.
        """
        if self._model.regression is None:
            raise NoSamples(f"task {self._spec.name!r} has no active sample to fit to")
        self._since_fit = 0
        return FitProblem.of(self._model, self._selection_kernel())

    def explain(self, state: object, sample_id: UUID | bytes | None = None) -> Explanation:
        """The samples behind the mean at a state (d,), and where one sample stands.

        Raises:
            Invalid: The state has another shape or is not finite; an unknown sample id.
            NoSamples: No sample is active.
        """
        sample = None
        if sample_id is not None:
            [row] = self._store.rows_of([id_from_wire(sample_id, "sample_id")])
            suppressor, radius = self._selection.standing(row)
            sample = SampleExplanation(
                id=self._store.ids(np.array([row]))[0],
                active=bool((self._selection.active == row).any()),
                eligible=bool(self._store.eligible(self._spec.learn_from)[row]),
                suppressor=None if suppressor is None else self._store.ids(np.array([suppressor]))[0],
                radius=radius,
            )
        return explain(self._model, state, sample)

    def apply_trials(self, seqs: Sequence[int], trials: Sequence[Trial]) -> None:
        """Applies trials with their log positions, in one step with one new model.

        Raises:
            Invalid: Positions that do not ascend from the version on.
            Conflict: An id that is stored already.
        """
        if not trials:
            return
        self._check_seqs(seqs, len(trials))
        known = [trial.id for trial in trials if self._store.find(trial.id) is not None]
        if known or len({trial.id for trial in trials}) != len(trials):
            raise Conflict(f"trials to apply must be new; known already or repeated: {known[:3]}")
        rows = np.array([self._store.append(seq, trial) for seq, trial in zip(seqs, trials, strict=True)])
        self._version = seqs[-1]
        if self._deferred:
            return
        eligible = rows[self._store.eligible(self._spec.learn_from)[rows]]
        self._since_fit += len(eligible)
        self._selection.extend(eligible)
        self._refresh(any(self._store.is_demonstration(row) for row in rows))

    def apply_recost(self, seq: int, ids: Sequence[UUID | bytes], costs: object) -> int:
        """Applies a change of costs at log position `seq`; see `recost`."""
        rows = self._rows_of(ids)
        checked = finite_array(costs, "costs", (len(rows),))
        values = [number(cost, "cost", low=0.0, high=1.0) for cost in checked.tolist()]
        self._check_seqs([seq], 1)
        changed = [(row, cost) for row, cost in zip(rows, values, strict=True) if self._store.costs[row] != cost]
        for row, cost in changed:
            self._store.recost(row, cost)
            if not (self._deferred or self._store.removed[row]):
                self._selection.recost(row)
        self._version = seq
        self._refresh(any(row in self._names for row, _ in changed))
        return len(changed)

    def apply_remove(self, seq: int, ids: Sequence[UUID | bytes]) -> int:
        """Applies a removal at log position `seq`; see `remove`."""
        rows = [row for row in self._rows_of(ids) if not self._store.removed[row]]
        self._check_seqs([seq], 1)
        for row in rows:
            self._store.remove(row)
            if not self._deferred:
                self._selection.remove(row)
        self._version = seq
        self._refresh(any(self._store.is_demonstration(row) for row in rows))
        return len(rows)

    def apply_configure(self, seq: int, changes: Mapping[str, Any]) -> TaskSpec:
        """Applies new settings at log position `seq`; see `configure`. Fitted numbers stay where none are given."""
        spec = self._spec.with_changes(changes)
        self._check_seqs([seq], 1)
        old, self._spec, self._version = self._spec, spec, seq
        if "kernel" in changes:
            variance = (
                spec.kernel.signal_variance if "signal_variance" in changes["kernel"] else self._kernel.signal_variance
            )
            self._kernel = Kernel(self._kernel.centre, self._kernel.lengthscales, variance, spec.kernel.linear_weight)
        if not self._deferred:
            if spec.budget != old.budget:
                self._selection.set_budget(spec.budget)
            if spec.learn_from != old.learn_from:
                self._selection.rebuild(self._eligible_rows())
        self._refresh(True)
        return spec

    def apply_fit(self, seq: int, lengthscales: object, signal_variance: object) -> None:
        """Applies fitted hyper-parameters at log position `seq`; the selection's length-scales stay.

        Raises:
            Invalid: Numbers that are not positive, or not d of them.
        """
        scales = finite_array(lengthscales, "lengthscales", (len(self._spec.state),))
        variance = number(signal_variance, "signal_variance", above=0.0)
        if (scales <= 0).any():
            raise Invalid(f"lengthscales must be positive; got {scales.tolist()}")
        self._check_seqs([seq], 1)
        self._kernel = Kernel(self._kernel.centre, scales, variance, self._kernel.linear_weight)
        self._version, self._since_fit = seq, 0
        self._refresh(True)

    @contextmanager
    def bulk(self, cache: RadiiCache | None = None) -> Iterator[None]:
        """Inside, `apply_...` calls only take note; the active set and the model are made once, at the end.

        Args:
            cache: Radii at the log position where the block ends; without them they are searched for, in about
                n log n. Ones of another position are ignored.
        """
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False
            fits = cache is not None and cache.version == self._version
            self._selection.set_budget(self._spec.budget)
            self._selection.rebuild(self._eligible_rows(), cache if fits else None)
            self._refresh(True)

    def radii(self) -> RadiiCache | None:
        """What makes the next `bulk` quick, where the selector has such a thing."""
        return self._selection.cache(self._version)

    def _selection_kernel(self) -> Array:
        return self._spec.lengthscales

    def _eligible_rows(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        return np.flatnonzero(self._store.eligible(self._spec.learn_from))

    def _rows_of(self, ids: Sequence[UUID | bytes]) -> list[int]:
        checked = [id_from_wire(value, "ids") for value in ids]
        if len(set(checked)) != len(checked):
            raise Invalid("ids must differ; one comes twice")
        return self._store.rows_of(checked)

    def _check_seqs(self, seqs: Sequence[int], count: int) -> None:
        ascending = all(later > earlier for earlier, later in zip([self._version, *seqs], seqs, strict=False))
        if len(seqs) != count or not ascending:
            raise Invalid(f"seqs must be {count} ascending numbers above {self._version}; got {list(seqs)[:5]}")

    def _refresh(self, changed: bool) -> None:
        """Makes the model for the present version, anew only where samples or settings changed."""
        if self._deferred:
            return
        if changed:
            self._update_parameters()
        if changed or self._selection.active is not self._rows:
            self._rows = self._selection.active
            self._model = self._fitted(self._model)
        else:
            self._model = self._model.at_version(self._version)

    def _update_parameters(self) -> None:
        rows = self._store.demonstrations() if self._spec.prior_mean == "demonstrations" else np.empty(0, np.int64)
        prior = self._store.goals[rows].mean(axis=0) if len(rows) else np.zeros(len(self._spec.goal))
        self._parameters = Parameters.create(self._spec, self._kernel, prior)

    def _fitted(self, previous: Model | None) -> Model:
        rows = self._rows
        new = [row for row in rows.tolist() if row not in self._names]
        names = {**self._names, **dict(zip(new, self._store.ids(np.array(new, dtype=np.int64)), strict=True))}
        self._names = {row: names[row] for row in rows.tolist()}
        return Model.create(
            self._version,
            self._parameters,
            list(self._names.values()),
            self._store.states[rows],
            self._store.goals[rows],
            self._store.costs[rows],
            previous,
        )
