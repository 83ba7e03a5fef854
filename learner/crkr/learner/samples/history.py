"""All trials at one moment, searched only on demand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.selection.anms_batch import Indices
from crkr.protocol import KINDS, Array

__all__ = ["WINDOW", "SuccessTrend", "TrialHistory"]

WINDOW: Final = 200  # newest trials
_TRIAL: Final = KINDS.index("trial")
_TRIED: Final = np.array([kind in {"trial", "failed"} for kind in KINDS])
_JUDGED: Final = np.array([kind == "evaluation" for kind in KINDS])


class SuccessTrend(NamedTuple):
    """Recent success rates.

    Attributes:
        trials: Number of newest trials, executed or refused; at most `WINDOW`.
        rate: Share of these that succeeded; None without any.
        before: Share of as many earlier trials; None if there are fewer.
        evaluated: Newest trials of kind evaluation; at most `WINDOW`.
        evaluation_rate: Share of these that succeeded; None without any.
    """

    trials: int
    rate: float | None
    before: float | None
    evaluated: int
    evaluation_rate: float | None


@final
@dataclass(frozen=True, slots=True, eq=False)
class TrialHistory:
    """Views of all stored trials, oldest first; cheap to make, and safe to read from other threads.

    Attributes:
        seqs: (n,) log positions.
        states: (n, d) [units of the state].
        goals: (n, p) [units of the goal].
        outcomes: (n, q) [units of the outcome]; q is 0 where the task does not learn from them.
        costs: (n,) NaN without a cost.
        kinds: (n,) positions in `KINDS`.
        flags: (n,) as `Trial.flags`.
        removed: (n,) whether removed from learning.
    """

    seqs: Indices
    states: Array
    goals: Array
    outcomes: Array
    costs: Array
    kinds: NDArray[np.uint8]
    flags: NDArray[np.uint8]
    removed: NDArray[np.bool_]

    @property
    def any_tried(self) -> bool:
        """Whether there is a trial, executed or refused, that is not removed; checks the newest first."""
        newest = len(self.seqs) > 0 and bool(_TRIED[self.kinds[-1]]) and not self.removed[-1]
        return newest or len(self.newest_tried(1)) > 0

    def newest_tried(self, count: int) -> Indices:
        """Rows of the newest trials, executed or refused, that are not removed; at most `count`, ascending."""
        return self._newest(_TRIED, count)

    def executed(self, rows: Indices) -> NDArray[np.bool_]:
        """Rows among these whose goal was executed."""
        executed: NDArray[np.bool_] = self.kinds[rows] == _TRIAL
        return executed

    def successes(self, rows: Indices) -> NDArray[np.bool_]:
        """Rows among these that succeeded."""
        return (self.flags[rows] & 1).astype(np.bool_)

    def trend(self) -> SuccessTrend:
        """Success rates of the newest trials, of those before, and of the newest evaluations."""
        tried, judged = self.newest_tried(2 * WINDOW), self._newest(_JUDGED, WINDOW)
        newest, before = tried[-WINDOW:], tried[:-WINDOW]
        earlier = self._rate(before) if len(before) == WINDOW else None
        return SuccessTrend(len(newest), self._rate(newest), earlier, len(judged), self._rate(judged))

    def _rate(self, rows: Indices) -> float | None:
        return float(self.successes(rows).mean()) if len(rows) else None

    def _newest(self, wanted: NDArray[np.bool_], count: int) -> Indices:
        """Rows of the newest trials of the kinds `wanted`, a table over `KINDS`."""
        found: list[Indices] = []
        missing, end = count, len(self.seqs)
        while missing > 0 and end > 0:
            start = max(0, end - 2 * count)
            rows = (wanted[self.kinds[start:end]] & ~self.removed[start:end]).nonzero()[0][-missing:]
            rows += start
            found.insert(0, rows)
            missing, end = missing - len(rows), start
        return found[0] if len(found) == 1 else np.concatenate([np.zeros(0, dtype=np.int64), *found])
