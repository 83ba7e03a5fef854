"""Summarises any number of trials for the figures of a page.

Memory and the size of a page do not grow with the run: trials are counted in equal spans, which are joined in pairs
whenever they become too many, and only the newest trials are kept one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.client.tally import wilson_interval
from crkr.dashboard.progress import MAX_NAMES, WINDOW, Progress, Row
from crkr.protocol import Array, TaskSpec

__all__ = ["COSTS", "KEPT", "SPANS", "Curve", "Figures", "Newest", "Spans"]

SPANS: Final = 240  # most spans; then they are joined in pairs
FIRST_WIDTH: Final = 5  # trials of a span
COSTS: Final = 25  # cells of [0, 1], of which the middle and the spread of costs are read
KEPT: Final = 4000  # newest training trials kept one by one


@final
@dataclass(frozen=True, slots=True)
class Curve:
    """A number over the run.

    Attributes:
        trials: (n,) training trials at the end of each window.
        value: (n,) the number.
        low: (n,) lower end of its band.
        high: (n,) upper end of its band.
        count: (n,) trials in each window.
    """

    trials: Array
    value: Array
    low: Array
    high: Array
    count: Array


@final
class Spans:
    """Counts over spans of equal length, at most `SPANS` of them.

    Attributes:
        width: Trials of a span now.
    """

    def __init__(self, columns: int) -> None:
        self.width = FIRST_WIDTH
        self._counts = np.zeros((SPANS, columns))
        self._last = 0

    def add(self, trials: NDArray[np.int64], columns: NDArray[np.int64]) -> None:
        """Count one in each of the columns (n,) for the training trials (n,), numbered from 1."""
        self._last = max(self._last, int(trials.max()))
        while self._last > SPANS * self.width:
            self._counts = np.concatenate([self._counts[::2] + self._counts[1::2], np.zeros_like(self._counts[::2])])
            self.width *= 2
        np.add.at(self._counts, ((trials - 1) // self.width, columns), 1)

    def windows(self, least: int = WINDOW) -> tuple[Array, Array]:
        """(n,) ends of windows, and (n, columns) the counts in each.

        Each window has at least `least` trials and a fortieth of the run; the windows overlap.
        """
        used = -(-self._last // self.width)
        if not used:
            return np.zeros(0), np.zeros((0, self._counts.shape[1]))
        size = min(used, max(-(-least // self.width) + 1, used // 40))  # the last span may not be full
        sums = np.concatenate([np.zeros((1, self._counts.shape[1])), np.cumsum(self._counts[:used], axis=0)])
        ends = np.minimum(np.arange(size, used + 1) * self.width, self._last)
        return ends.astype(float), sums[size:] - sums[:-size]

    def total(self) -> Array:
        """(columns,) counts over the whole run."""
        return np.asarray(self._counts.sum(axis=0))


@final
class Newest:
    """The newest training trials, one by one."""

    def __init__(self, spec: TaskSpec) -> None:
        self._states = np.zeros((KEPT, len(spec.state)))
        self._outcomes = np.full((KEPT, len(spec.outcome)), np.nan)
        self._success = np.zeros(KEPT, dtype=bool)
        self._added = 0

    def add(self, row: Row) -> None:
        """Keep a training trial in place of the oldest."""
        trial, place = row.stored.trial, self._added % KEPT
        self._states[place] = trial.state
        self._success[place] = trial.success
        self._outcomes[place] = np.nan if trial.outcome is None else trial.outcome
        self._added += 1

    def __len__(self) -> int:
        return min(self._added, KEPT)

    @property
    def states(self) -> Array:
        """(n, d)."""
        return self._states[: len(self)]

    @property
    def outcomes(self) -> Array:
        """(n, q), NaN where nothing was observed."""
        return self._outcomes[: len(self)]

    @property
    def success(self) -> NDArray[np.bool_]:
        """(n,)."""
        return self._success[: len(self)]


@final
class Figures:
    """The figures of a run.

    Attributes:
        spec: Of the task.
        progress: Counts of the run; it numbers the trials that are added here.
        newest: The newest training trials.
        last: When the newest was [unix s].
        heard: When each worker's newest trial was stored [unix s].
    """

    def __init__(self, spec: TaskSpec, progress: Progress | None = None) -> None:
        self.spec = spec
        self.progress = Progress(running=False) if progress is None else progress
        self.newest = Newest(spec)
        self.last: float | None = None
        self.heard: dict[str, float] = {}
        self._spans = Spans(sum(_COLUMNS.values()))
        self._reasons: list[str] = []

    def add(self, rows: Sequence[Row]) -> None:
        """Count trials, which `progress` has numbered, in the order of seq."""
        for row in rows:
            self.heard[row.worker] = row.stored.time
        trained = [row for row in rows if row.kind in ("trial", "failed")]
        if not trained:
            return
        self.last = trained[-1].stored.time
        for row in trained[-KEPT:]:
            self.newest.add(row)
        places = {name: place for place, name in enumerate(self.progress.criteria)}
        counted = [(row.trial, places[name]) for row in trained for name in row.outcomes]
        counted += [(row.trial, _MET + places[name]) for row in trained for name, met in row.outcomes.items() if met]
        counted += [(row.trial, _COST + _cell(row.cost)) for row in trained if row.cost is not None]
        counted += [(row.trial, _REASON + self._reason(row.reason)) for row in trained]
        trials, columns = np.array(counted).T
        self._spans.add(trials, columns)

    def _reason(self, name: str) -> int:
        if name not in self._reasons:
            self._reasons.append(name)
        return self._reasons.index(name)

    def success(self, criterion: str) -> Curve:
        """Share of successful training trials over the run, with Wilson's 95 % interval."""
        place = self.progress.criteria.index(criterion)
        ends, counts = self._spans.windows()
        ends, counts = ends[counts[:, place] > 0], counts[counts[:, place] > 0]
        judged, met = counts[:, place], counts[:, _MET + place]
        bands = [wilson_interval(int(good), int(all_)) for good, all_ in zip(met, judged, strict=True)]
        low, high = np.array(bands).reshape(-1, 2).T
        return Curve(ends, met / judged, low, high, judged)

    def cost(self) -> Curve:
        """Median cost of training trials over the run, with the range of the middle four fifths."""
        ends, counts = self._spans.windows()
        cells = counts[:, _COST : _COST + COSTS]
        ends, cells = ends[cells.sum(axis=1) > 0], cells[cells.sum(axis=1) > 0]
        low, middle, high = (_quantile(cells, share) for share in (0.1, 0.5, 0.9))
        return Curve(ends, middle, low, high, cells.sum(axis=1))

    def reasons(self) -> tuple[Array, dict[str, Array]]:
        """(n,) ends of windows over the run, and by reason the (n,) shares of trials that ended so; frequent first."""
        ends, counts = self._spans.windows()
        totals = self._spans.total()[_REASON:]
        order = sorted(range(len(self._reasons)), key=lambda place: -totals[place])
        whole = np.maximum(counts[:, _REASON:].sum(axis=1), 1)
        return ends, {self._reasons[place]: counts[:, _REASON + place] / whole for place in order}


# What is counted in each span, and in which columns.
_COLUMNS: Final = {"judged": MAX_NAMES, "met": MAX_NAMES, "cost": COSTS, "reason": MAX_NAMES + 1}
_MET: Final = MAX_NAMES
_COST: Final = 2 * MAX_NAMES
_REASON: Final = 2 * MAX_NAMES + COSTS


def _cell(cost: float) -> int:
    return min(int(cost * COSTS), COSTS - 1)


def _quantile(cells: Array, share: float) -> Array:
    """(n,) quantiles of costs that were counted in cells (n, COSTS), evenly spread within each."""
    sums = np.cumsum(cells, axis=1)
    wanted = share * sums[:, -1]
    place = (sums < wanted[:, None]).sum(axis=1)
    rows = np.arange(len(cells))
    before = sums[rows, place] - cells[rows, place]
    return np.asarray((place + (wanted - before) / np.maximum(cells[rows, place], 1)) / COSTS)
