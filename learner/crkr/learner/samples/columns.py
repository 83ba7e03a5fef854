"""Many trials as columns, which a log reads faster than trial by trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import Array, Invalid

__all__ = ["TrialColumns"]


@final
@dataclass(frozen=True, slots=True, eq=False)
class TrialColumns:
    """n trials, checked when they were first reported, in log order.

    Attributes:
        seqs: (n,) log positions, ascending.
        ids: 16 n bytes.
        digests: 16 n bytes, as `Trial.digest` gives them.
        states: (n, d) [units of the state].
        goals: (n, p) [units of the goal].
        costs: (n,) as reported, NaN without a cost.
        kinds: (n,) positions in `KINDS`.
        flags: (n,) `success` and `learn`, as `Trial.flags` gives them.
        outcomes: (n, q) as reported, NaN where not observed; may be None if the task does not learn from them.

    Raises:
        Invalid: Columns of different lengths.
    """

    seqs: Indices
    ids: bytes
    digests: bytes
    states: Array
    goals: Array
    costs: Array
    kinds: NDArray[np.uint8]
    flags: NDArray[np.uint8]
    outcomes: Array | None = None

    def __post_init__(self) -> None:
        lengths: list[float] = [len(one) for one in (self.states, self.goals, self.costs, self.kinds, self.flags)]
        lengths += [] if self.outcomes is None else [len(self.outcomes)]
        lengths += [len(self.ids) / 16, len(self.digests) / 16]
        if any(length != len(self.seqs) for length in lengths):
            raise Invalid(f"columns must have one entry a trial; got {lengths} for {len(self.seqs)} log positions")

    def __len__(self) -> int:
        return len(self.seqs)

    def where(self, mask: NDArray[np.bool_]) -> TrialColumns:
        """The trials of a mask (n,)."""
        ids, digests = (np.frombuffer(data, "V16")[mask].tobytes() for data in (self.ids, self.digests))
        states, goals, costs = self.states[mask], self.goals[mask], self.costs[mask]
        outcomes = None if self.outcomes is None else self.outcomes[mask]
        return TrialColumns(
            self.seqs[mask], ids, digests, states, goals, costs, self.kinds[mask], self.flags[mask], outcomes
        )
