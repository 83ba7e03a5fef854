"""Every reported trial, in columns: some 220 bytes per trial at d = 6, p = 13, and 8 per outcome."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.growable_array import Growable
from crkr.learner.samples.history import TrialHistory
from crkr.learner.samples.id_index import IdIndex, id_words
from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import KINDS, Array, Conflict, Invalid, Trial
from crkr.protocol.trial import flags_of, may_learn, success_and_learn

__all__ = ["Review", "SampleStore"]

_TRIAL: Final = KINDS.index("trial")
_DEMONSTRATION: Final = KINDS.index("demonstration")
_EVALUATION: Final = KINDS.index("evaluation")
_FAILED: Final = KINDS.index("failed")
# For each value of `Trial.flags`, whether a trial of kind "trial" may be learned from.
_MAY_LEARN: Final = {
    learn_from: np.array([may_learn(*success_and_learn(flags), learn_from) for flags in range(8)])
    for learn_from in ("successes", "all")
}


@final
@dataclass(frozen=True, slots=True)
class Review:
    """Which trials of a report are new.

    Attributes:
        fresh: Positions in the report of the trials to store, in order.
        known: Log position of each trial that is stored already, else None.
        same_as: Position in the report of the first trial with the same id, usually its own.
    """

    fresh: tuple[int, ...]
    known: tuple[int | None, ...]
    same_as: tuple[int, ...]

    def seqs(self, first: int) -> tuple[int, ...]:
        """Log positions in report order, if the new trials are stored from `first` on."""
        given = {position: first + count for count, position in enumerate(self.fresh)}
        return tuple(
            known if known is not None else given[same] for known, same in zip(self.known, self.same_as, strict=True)
        )


@final
class SampleStore:
    """Columns of trials in log order; rows are numbered from 0 and never move.

    Args:
        dimensions: d.
        outputs: p.
        outcomes: q; 0 if outcomes are not learned from.
    """

    def __init__(self, dimensions: int, outputs: int, outcomes: int = 0) -> None:
        self._ids = Growable(np.uint64, (2,))
        self._digests = Growable(np.uint64, (2,))
        self._seqs = Growable(np.int64)
        self._states = Growable(np.float64, (dimensions,))
        self._goals = Growable(np.float64, (outputs,))
        self._outcomes = Growable(np.float64, (outcomes,))
        self._costs = Growable(np.float64)
        self._kinds = Growable(np.uint8)
        self._flags = Growable(np.uint8)
        self._removed = Growable(np.bool_)
        self._keeps_outcomes = outcomes > 0
        self._index = IdIndex()
        self._given = False  # a history shows the present kinds, flags and removals

    def __len__(self) -> int:
        return len(self._seqs)

    @property
    def states(self) -> Array:
        """(n, d) states, in their units."""
        return self._states.rows

    @property
    def goals(self) -> Array:
        """(n, p) executed goals, in their units."""
        return self._goals.rows

    @property
    def outcomes(self) -> Array:
        """(n, q) measured outcomes, in their units; NaN where not observed."""
        return self._outcomes.rows

    @property
    def costs(self) -> Array:
        """(n,) current costs; NaN without one."""
        return self._costs.rows

    @property
    def seqs(self) -> Indices:
        """(n,) log positions, ascending."""
        return self._seqs.rows

    @property
    def removed(self) -> NDArray[np.bool_]:
        """(n,) whether removed from learning."""
        return self._removed.rows

    def append(self, seq: int, trial: Trial) -> int:
        """Stores a trial whose id is new; returns its row."""
        row = len(self._seqs)
        self._ids.append(id_words(trial.id.bytes))
        self._digests.append(id_words(trial.digest()))
        self._seqs.append(seq)
        self._states.append(trial.state)
        self._goals.append(trial.goal)
        if self._keeps_outcomes:
            self._outcomes.append(np.nan if trial.outcome is None else trial.outcome)
        self._costs.append(np.nan if trial.cost is None else trial.cost)
        self._kinds.append(KINDS.index(trial.kind))
        self._flags.append(trial.flags)
        self._removed.append(False)
        self._index.add(row, self._ids.rows)
        return row

    def extend(self, columns: TrialColumns) -> int | None:
        """Stores trials with new ids; returns None, or a row with a known id, after which the store is unusable.

        Raises:
            Invalid: Outcomes are missing and learned from.
        """
        if self._keeps_outcomes:
            if columns.outcomes is None:
                raise Invalid("this task learns from outcomes; columns must have them, NaN where not observed")
            self._outcomes.extend(columns.outcomes)
        for column, values in (
            (self._ids, np.frombuffer(columns.ids, "<u8").reshape(-1, 2)),
            (self._digests, np.frombuffer(columns.digests, "<u8").reshape(-1, 2)),
            (self._seqs, columns.seqs),
            (self._states, columns.states),
            (self._goals, columns.goals),
            (self._costs, columns.costs),
            (self._kinds, columns.kinds),
            (self._flags, columns.flags),
            (self._removed, np.zeros(len(columns), dtype=np.bool_)),
        ):
            column.extend(values)
        return self._index.extend(self._ids.rows)

    def find(self, trial_id: UUID) -> int | None:
        """Row of a trial, or None."""
        return self._index.find(id_words(trial_id.bytes), self._ids.rows)

    def rows_of(self, ids: Sequence[UUID]) -> list[int]:
        """Rows of stored trials.

        Raises:
            Invalid: An id that was never reported.
        """
        rows = [self.find(trial_id) for trial_id in ids]
        unknown = [str(trial_id) for trial_id, row in zip(ids, rows, strict=True) if row is None]
        if unknown:
            shown = ", ".join(unknown[:5])
            raise Invalid(f"{len(unknown)} unknown ids: {shown}", details={"ids": unknown[:100]})
        return [row for row in rows if row is not None]

    def review(self, trials: Sequence[Trial]) -> Review:
        """Finds the new trials of a report, without storing them.

        Raises:
            Conflict: A known id with other content.
        """
        first: dict[UUID, int] = {}
        fresh, known, same_as = [], [], []
        for position, trial in enumerate(trials):
            row = self.original(trial)
            earlier = first.setdefault(trial.id, position)
            if earlier != position and trials[earlier].digest() != trial.digest():
                raise Conflict(
                    f"id {trial.id} comes twice in one report with different content; use a new id for a new trial",
                    details={"id": str(trial.id)},
                )
            if row is None and earlier == position:
                fresh.append(position)
            known.append(None if row is None else int(self.seqs[row]))
            same_as.append(earlier)
        return Review(tuple(fresh), tuple(known), tuple(same_as))

    def original(self, trial: Trial) -> int | None:
        """Row of the same trial, or None; raises `Conflict` if its id has other content."""
        row = self.find(trial.id)
        if row is not None and tuple(self._digests.rows[row].tolist()) != id_words(trial.digest()):
            raise Conflict(
                f"id {trial.id} was reported before with other content; use a new id for a new trial",
                details={"id": str(trial.id), "seq": int(self.seqs[row])},
            )
        return row

    def ids(self, rows: Indices) -> list[UUID]:
        """Ids of some rows."""
        stream = self._ids.rows[rows].astype("<u8").tobytes()
        return [UUID(bytes=stream[start : start + 16]) for start in range(0, len(stream), 16)]

    def eligible(self, rows: Indices, learn_from: str) -> NDArray[np.bool_]:
        """Which of these rows may be learned from: demonstrations, and trials chosen by `learn` or `learn_from`."""
        kinds, flags = self._kinds.rows[rows], self._flags.rows[rows]
        tried = (kinds == _TRIAL) & _MAY_LEARN[learn_from][flags]
        eligible: NDArray[np.bool_] = (tried | (kinds == _DEMONSTRATION)) & ~self._removed.rows[rows]
        return eligible

    def tried(self, rows: Indices) -> NDArray[np.bool_]:
        """Which of these rows show what a goal leads to: all but evaluations and removed ones."""
        judged = self._kinds.rows[rows] == _EVALUATION
        tried: NDArray[np.bool_] = ~(judged | self._removed.rows[rows])
        return tried

    def refused(self, rows: Indices) -> NDArray[np.bool_]:
        """Which of these rows were refused or could not be measured (kind "failed")."""
        refused: NDArray[np.bool_] = self._kinds.rows[rows] == _FAILED
        return refused

    def successes(self, rows: Indices) -> NDArray[np.bool_]:
        """Which of these rows succeeded."""
        return (self._flags.rows[rows] & 1).astype(np.bool_)

    def history(self) -> TrialHistory:
        """Views of all present trials; later changes show in them for costs and outcomes only."""
        self._given = True
        return TrialHistory(
            self._seqs.rows,
            self._states.rows,
            self._goals.rows,
            self._outcomes.rows if self._keeps_outcomes else np.empty((len(self), 0)),
            self._costs.rows,
            self._kinds.rows,
            self._flags.rows,
            self._removed.rows,
        )

    def count_tried(self, rows: Indices) -> int:
        """Number of trials among these rows, executed or refused."""
        kinds = self._kinds.rows[rows]
        return int(np.count_nonzero((kinds == _TRIAL) | (kinds == _FAILED)))

    def demonstrations(self) -> Indices:
        """Rows of the demonstrations that are not removed."""
        return np.flatnonzero((self._kinds.rows == _DEMONSTRATION) & ~self._removed.rows)

    def demonstrated(self, rows: Indices) -> NDArray[np.bool_]:
        """Which of these rows are demonstrations."""
        demonstrated: NDArray[np.bool_] = self._kinds.rows[rows] == _DEMONSTRATION
        return demonstrated

    def counts(self) -> dict[str, int]:
        """Number of stored trials by kind, removed ones too."""
        found = np.bincount(self._kinds.rows, minlength=len(KINDS))
        return {kind: int(count) for kind, count in zip(KINDS, found, strict=True)}

    def recost(self, row: int, cost: float) -> None:
        """Changes the current cost; duplicates are still compared with the reported one."""
        self._costs.rows[row] = cost

    def amend(self, row: int, values: Mapping[str, Any]) -> None:
        """Changes the columns of `AMENDABLE`, and `removed`; id and digest stay."""
        self._detach()
        self._costs.rows[row] = np.nan if values["cost"] is None else values["cost"]
        self._flags.rows[row] = flags_of(values["success"], values["learn"])
        self._kinds.rows[row] = KINDS.index(values["kind"])
        self._removed.rows[row] = values["removed"]
        if self._keeps_outcomes:
            self._outcomes.rows[row] = np.nan if values["outcome"] is None else values["outcome"]

    def remove(self, row: int) -> None:
        """Removes a trial from learning."""
        self._detach()
        self._removed.rows[row] = True

    def _detach(self) -> None:
        """Copies columns before a change, so that histories stay unchanged."""
        if self._given:
            for column in (self._kinds, self._flags, self._removed):
                column.detach()
            self._given = False
