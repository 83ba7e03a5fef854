"""Numbers over the run, sent in batches as rows of scalar entities."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from statistics import median
from typing import Any, Final, final

import rerun as rr

from crkr.dashboard.progress import WINDOW, EpochResult, Progress, Row
from crkr.dashboard.rerun_view.blueprint import CRITERIA, FAILURE, LINES, MEAN, NEUTRAL, SUCCESS, shade
from crkr.dashboard.rerun_view.recording import NameLimit, Recording
from crkr.dashboard.status_facts import drift_score, latency_ms
from crkr.dashboard.telemetry import Telemetry

__all__ = ["Curves"]

Path = tuple[str, ...]
MAX_PHASES: Final = 16  # names of durations


@final
class Curves:
    """Numbers that are collected, and sent together for each entity.

    Attributes:
        waiting: Count of numbers not yet sent.
    """

    def __init__(self, recording: Recording, say: Callable[[str], object]) -> None:
        self._recording = recording
        self._phases = NameLimit("timed phases", MAX_PHASES, MAX_PHASES, say)
        self._styled: set[Path] = set()
        self._rows: dict[Path, list[tuple[int, int, float]]] = defaultdict(list)
        self._durations: dict[str, list[float]] = defaultdict(list)
        self._recent: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=WINDOW))
        self._last_status_trial = -1
        self.waiting = 0

    def trials(self, rows: Iterable[Row]) -> None:
        """Cost, running success and running reasons of training trials."""
        for row in rows:
            if row.kind not in ("trial", "failed"):
                continue
            if row.cost is not None:
                met = "success" if row.success else "failure"
                self._point(("cost", met), row, row.cost, SUCCESS if row.success else FAILURE, met)
            if row.mean_cost is not None:
                self._line(("cost", "mean"), row, row.mean_cost, MEAN, "mean of 50")
            for index, (name, rate) in enumerate(row.rates.items()):
                colour = shade(CRITERIA[index % len(CRITERIA)], 0.45)
                self._line(("training", name), row, rate, colour, f"{name}, exploring", 1.0)
            for index, (name, share) in enumerate(row.shares.items()):
                self._line(("reasons", name), row, share, LINES[index % len(LINES)], name)
            for index, (name, share) in enumerate(row.predictions.items()):
                self._line(("predictions", name.replace(" ", "_")), row, share, LINES[index], f"{name}, last 200")

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """Sigma and novelty of the goal that was tried, and the durations of the trial."""
        if row.kind not in ("trial", "failed"):
            return
        measured = (("sigma", telemetry.sigma_mean, LINES[0]), ("novelty", telemetry.novelty, LINES[1]))
        for name, value, colour in measured:
            if value is not None:
                recent = self._recent[name]
                recent.append(value)
                self._point(("exploration", name), row, value, shade(colour, 0.4), f"{name}, each trial")
                self._line(("exploration", f"{name}_mean"), row, sum(recent) / len(recent), colour, f"{name}, last 50")
        for name, duration in telemetry.timing_ms.items():
            self._durations[name if self._phases.admits(name) else "other"].append(duration)

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """Success of one evaluation with its 95 % interval."""
        times = {"trial": result.trial, "epoch": result.epoch}
        for index, name in enumerate(progress.criteria):
            if not result.tally.judged[name]:
                continue
            colour = CRITERIA[index % len(CRITERIA)]
            low, high = result.tally.interval(name)
            # The band is one standard deviation wide on each side of its middle, which is not quite the rate.
            band = rr.Measurements(
                (low + high) / 2,
                variances=((high - low) / 2) ** 2,
                colors=colour,
                widths=0.1,
                names=f"{name}, 95 %",
            )
            self._recording.at(times, ("evaluation", name, "interval"), band)
            self._append(
                ("evaluation", name, "rate"),
                times["trial"],
                times["epoch"],
                result.tally.rate(name),
                partial(rr.SeriesLines, colors=colour, names=name, widths=2.5),
            )

    def status(self, status: Mapping[str, Any], progress: Progress) -> None:
        """Active set and samples, and the server's own latency."""
        if progress.trials == self._last_status_trial:
            return
        self._last_status_trial = progress.trials
        for name, colour in (("eligible", NEUTRAL), ("active", LINES[3])):
            value = status.get(name)
            if isinstance(value, int | float):
                style = partial(rr.SeriesLines, colors=colour, names=name, widths=2.0)
                self._append(("learner", name), progress.trials, progress.epoch, float(value), style)
        if (score := drift_score(status)) is not None:
            style = partial(rr.SeriesLines, colors=LINES[4], names="drift: restart above 20", widths=2.0)
            self._append(("drift", "score"), progress.trials, progress.epoch, score, style)
        served = latency_ms(status)
        for verb, colour in (("predict", LINES[4]), ("report", LINES[5])):
            if verb in served:
                style = partial(rr.SeriesLines, colors=colour, names=f"server: {verb}, p99")
                self._append(("latency", f"server_{verb}"), progress.trials, progress.epoch, served[verb][1], style)

    def flush(self, progress: Progress) -> None:
        """Send what was collected."""
        for index, (name, durations) in enumerate(sorted(self._durations.items())):
            style = partial(rr.SeriesLines, colors=LINES[index % len(LINES)], names=f"worker: {name}", widths=1.5)
            self._append(("latency", f"worker_{name}"), progress.trials, progress.epoch, median(durations), style)
        self._durations.clear()
        for path, rows in self._rows.items():
            self._recording.columns(
                path,
                [
                    rr.TimeColumn("trial", sequence=[trial for trial, _, _ in rows]),
                    rr.TimeColumn("epoch", sequence=[epoch for _, epoch, _ in rows]),
                ],
                rr.Scalars.columns(scalars=[value for _, _, value in rows]),
            )
        self._rows.clear()
        self.waiting = 0

    def _line(self, path: Path, row: Row, value: float, colour: int, name: str, width: float = 1.5) -> None:
        self._append(path, row.trial, row.epoch, value, lambda: rr.SeriesLines(colors=colour, names=name, widths=width))

    def _point(self, path: Path, row: Row, value: float, colour: int, name: str) -> None:
        self._append(
            path,
            row.trial,
            row.epoch,
            value,
            lambda: rr.SeriesPoints(colors=colour, names=name, markers="circle", marker_sizes=1.8),
        )

    def _append(self, path: Path, trial: int, epoch: int, value: float, style: Callable[[], Any]) -> None:
        if path not in self._styled:
            self._styled.add(path)
            self._recording.fixed(path, style())  # made once, as it takes longer than the rest
        self._rows[path].append((trial, epoch, value))
        self.waiting += 1
