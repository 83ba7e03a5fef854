"""Judged policies as rows of a CSV file that a comparison completes, and their summary."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from scipy.stats import bootstrap, trim_mean

from crkr.client.cli.console import print_table, stdout
from crkr.experiments.learning.run import Score
from crkr.protocol import Invalid

__all__ = [
    "Comparison",
    "Row",
    "Rows",
    "Summary",
    "compare",
    "comparison_cell",
    "interval",
    "judged_row",
    "print_summary",
    "rates",
    "summarise",
    "summary_table",
]

RESAMPLES: Final = 2000


@final
@dataclass(frozen=True, slots=True)
class Row:
    """One policy, judged once.

    Attributes:
        way: The method, e.g. a rival's name.
        seed: Of demonstrations, training contexts and exploration.
        trials: Training trials that it had learned from.
        successes: Judged contexts that succeeded by one criterion of the skill, its last and strictest unless told.
        contexts: Judged contexts.
    """

    way: str
    seed: int
    trials: int
    successes: int
    contexts: int


def judged_row(way: str, seed: int, score: Score, criterion: str | None = None) -> Row:
    """The row of a score by a criterion, or by the skill's last one.

    Raises:
        Invalid: The skill has no such criterion.
    """
    there = list(score.tally.criteria)
    if not there:  # nothing was executed, as there was no policy yet
        return Row(way, seed, score.trials, 0, score.contexts)
    criterion = criterion or there[-1]
    if criterion not in there:
        raise Invalid(f"no criterion {criterion!r}; there are: {', '.join(there)}")
    return Row(way, seed, score.trials, score.tally.successes.get(criterion, 0), score.contexts)


@final
class Rows:
    """The rows of a comparison; with a folder they are kept in its file, and runs in it are not made again.

    Args:
        folder: Where to keep them; None keeps nothing.
        name: Of the file, e.g. rivals.csv; the settings are in rivals.json beside it.
        settings: What all rows have in common, as plain data.

    Raises:
        Invalid: The folder holds rows of other settings, or a file of another experiment.
    """

    def __init__(self, folder: Path | None, name: str, settings: Mapping[str, Any]) -> None:
        self._path = None if folder is None else folder / name
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            _check_settings(self._path.with_suffix(".json"), settings)
        self.all: list[Row] = [] if self._path is None else _read(self._path)

    def missing(self, ways: Iterable[str], seeds: Iterable[int], last: int) -> Iterator[tuple[str, int]]:
        """Ways and seeds whose run up to `last` trials is not there yet."""
        there = {(row.way, row.seed) for row in self.all if row.trials == last}
        names = tuple(ways)
        return ((way, seed) for seed in seeds for way in names if (way, seed) not in there)

    def add(self, rows: Sequence[Row]) -> None:
        """Keeps the rows of one run; marks that an earlier run of it was judged at are kept as they were."""
        there = {(row.way, row.seed, row.trials) for row in self.all}
        rows = [row for row in rows if (row.way, row.seed, row.trials) not in there]
        self.all += rows
        if self._path is None:
            return
        if not self._path.exists():
            _write(self._path, [], "w")
        _write(self._path, rows, "a")

    def sort(self) -> None:
        """Sorts the rows of the file, so that it does not depend on the processes' speed."""
        self.all.sort(key=lambda row: (row.way, row.seed, row.trials))
        if self._path is not None and self.all:
            partial = self._path.with_suffix(".partial")
            _write(partial, self.all, "w")
            partial.replace(self._path)


def _write(path: Path, rows: Iterable[Row], mode: str) -> None:
    with path.open(mode, newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [entry.name for entry in fields(Row)])
        if mode == "w":
            writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def _check_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Writes the settings, or compares them with existing ones."""
    if not path.exists():
        path.write_text(json.dumps(settings, indent=1) + "\n", encoding="utf-8")
        return
    kept = json.loads(path.read_text(encoding="utf-8"))
    differ = [name for name in settings if kept.get(name) != settings[name]]
    if differ:
        was = ", ".join(f"{name} {kept.get(name)}" for name in differ)
        raise Invalid(f"{path.parent} holds runs with {was}; choose another folder for --out")


def _read(path: Path) -> list[Row]:
    """The rows of a CSV file; none where there is no file.

    Raises:
        Invalid: It has other columns or values.
    """
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        if reader.fieldnames != [entry.name for entry in fields(Row)]:
            raise Invalid(f"{path} holds another experiment; choose another folder for --out")
        try:
            return [
                Row(row["way"], *(int(row[name]) for name in ("seed", "trials", "successes", "contexts")))
                for row in reader
            ]
        except (TypeError, ValueError) as error:
            raise Invalid(f"{path}: a row cannot be read ({error}); remove it or choose another folder") from error


@final
@dataclass(frozen=True, slots=True)
class Summary:
    """One way at one mark, over its seeds.

    Attributes:
        mean: Interquartile mean of the success rates.
        low: Of its 95 % interval, by the stratified bootstrap.
        high: Likewise.
        worst: Least rate.
        seeds: Number of runs.
    """

    mean: float
    low: float
    high: float
    worst: float
    seeds: int


def summarise(rows: Sequence[Row], way: str, trials: int) -> Summary:
    """Summarises the rows of one way at a mark, of which there is at least one."""
    found = np.array(list(rates(rows, way, trials).values()))
    mean, low, high = interval([found], _interquartile_mean)
    return Summary(mean, low, high, float(found.min()), len(found))


def rates(rows: Sequence[Row], way: str, trials: int, *, area: bool = False) -> dict[int, float]:
    """Seed -> success rate after `trials`; with `area` the mean rate up to there, the area under its curve."""
    curves: dict[int, dict[int, float]] = {}
    for row in rows:
        if row.way == way and row.trials <= trials:
            curves.setdefault(row.seed, {})[row.trials] = row.successes / row.contexts
    whole = {seed: curve for seed, curve in curves.items() if trials in curve}
    return {seed: _area(curve) if area else curve[trials] for seed, curve in whole.items()}


def _area(curve: Mapping[int, float]) -> float:
    marks = sorted(curve)
    values = [curve[mark] for mark in marks]
    return values[0] if len(marks) == 1 else float(np.trapezoid(values, marks) / (marks[-1] - marks[0]))


@final
@dataclass(frozen=True, slots=True)
class Comparison:
    """Ways beside others on the same seeds, each number with its 95 % interval by the stratified bootstrap.

    Attributes:
        gain: Interquartile mean of the differences, seed by seed, and its interval.
        better: Probability of improvement: the share of seeds at which it is better, draws counted half.
        seeds: Number of pairs.
    """

    gain: tuple[float, float, float]
    better: tuple[float, float, float]
    seeds: int


def compare(
    rows: Sequence[Row], pairs: Iterable[tuple[str, str]], trials: int, *, area: bool = False
) -> Comparison | None:
    """Compares the first of each pair with its second, one stratum a pair, by `rates`; None: no seed has both."""
    strata = []
    for way, other in pairs:
        mine, theirs = rates(rows, way, trials, area=area), rates(rows, other, trials, area=area)
        if both := sorted(mine.keys() & theirs.keys()):
            strata.append(np.array([mine[seed] - theirs[seed] for seed in both]))
    if not strata:
        return None
    wins = [0.5 + 0.5 * np.sign(differences) for differences in strata]
    return Comparison(interval(strata, _interquartile_mean), interval(wins, np.mean), sum(map(len, strata)))


def comparison_cell(found: Comparison | None, field: str) -> str:
    """One number of a comparison with its interval, for a table; empty without one."""
    if found is None:
        return ""
    value, low, high = getattr(found, field)
    sign = "+" if field == "gain" else ""
    return f"{value:{sign}.3f} [{low:{sign}.3f}, {high:{sign}.3f}]"


def interval(strata: Sequence[np.ndarray], statistic: Callable[..., Any]) -> tuple[float, float, float]:
    """A statistic of all strata together, and its 95 % interval where each has two entries or more."""

    def pooled(*parts: np.ndarray, axis: int = -1) -> Any:
        return statistic(np.concatenate(parts, axis=axis), axis=axis)

    value = float(pooled(*strata))
    if min(map(len, strata)) < 2:
        return value, value, value
    rng = np.random.default_rng(0)
    found = bootstrap(tuple(strata), pooled, n_resamples=RESAMPLES, method="percentile", random_state=rng)
    return value, float(found.confidence_interval.low), float(found.confidence_interval.high)


def _interquartile_mean(values: np.ndarray, axis: int) -> Any:
    return trim_mean(values, 0.25, axis=axis)


def summary_table(rows: Sequence[Row], ways: Iterable[str], marks: Iterable[int]) -> list[dict[str, Any]]:
    """Each way's summary at each mark that it was judged at."""
    there = {(row.way, row.trials) for row in rows}
    wanted = tuple(marks)
    return [
        {"way": way, "marks": {mark: summarise(rows, way, mark) for mark in wanted if (way, mark) in there}}
        for way in ways
    ]


def print_summary(
    table: Sequence[Mapping[str, Any]], marks: Sequence[int], title: str, extra: Mapping[str, Callable[[str], str]]
) -> None:
    """Prints the table, with columns of their own for `extra`, heading -> cell of a way."""
    stdout.print(f"{title}: interquartile mean of success [95 % interval], worst run")
    lines = []
    for row in table:
        cells = [
            "" if one is None else f"{one.mean:.3f} [{one.low:.3f}, {one.high:.3f}], {one.worst:.3f}"
            for one in map(row["marks"].get, marks)
        ]
        lines.append((row["way"], *cells, *(cell(row["way"]) for cell in extra.values())))
    print_table(("way", *(f"after {mark}" for mark in marks), *extra), lines)
