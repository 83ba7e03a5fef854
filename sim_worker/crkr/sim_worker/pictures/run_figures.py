"""Figures of any task's trials: success and cost over the run, and the tried states."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.client.tally import success_by_criterion, wilson_interval
from crkr.protocol import Array, Invalid, StateDimension, StoredTrial, TaskSpec
from crkr.sim_worker.demo.learning_curve import COLOURS
from crkr.sim_worker.evaluation.run_history import RunHistory
from crkr.sim_worker.figure import new_figure, save_figure

__all__ = ["Run", "draw_coverage", "draw_learning"]

WINDOW: Final = 50
POINTS: Final = 400  # of a curve
SHOWN: Final = 4000  # newest trials in a scatter plot
AXES: Final = 6  # coordinates in a matrix of scatter plots
GOOD, BAD, ACTIVE = "#009E73", "#D55E00", "#0072B2"


@final
class Run:
    """The training trials of a task, and its evaluations."""

    def __init__(self, spec: TaskSpec, trials: Iterable[StoredTrial]) -> None:
        self.spec = spec
        self.history = RunHistory(spec)
        self.met: list[dict[str, bool]] = []
        self.costs: list[float] = []
        self.states: list[Array] = []
        self.success: list[bool] = []
        for stored in trials:
            self.history.add(stored)
            trial = stored.trial
            if trial.kind in ("trial", "failed"):
                self.met.append(success_by_criterion(trial.success, trial.info))
                self.costs.append(np.nan if trial.cost is None else trial.cost)
                self.states.append(trial.state)
                self.success.append(trial.success)

    def criteria(self) -> list[str]:
        """Names of what counts as success, in order of appearance."""
        return list(dict.fromkeys(name for met in self.met for name in met))[: len(COLOURS)]


def draw_learning(run: Run, path: Path) -> None:
    """Saves success and cost over training trials, with their spread.

    Raises:
        Invalid: There is no training trial.
    """
    if not run.met:
        raise Invalid(f"task {run.spec.name!r} has no training trial yet; start some: crkr workers")
    figure = new_figure(8.0, 6.4)
    success, cost = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1.0])
    size = max(WINDOW, len(run.met) // 40)
    for name, colour in zip(run.criteria(), COLOURS, strict=False):
        trials, rate, low, high = _rates([met.get(name) for met in run.met], size)
        success.fill_between(trials, 100 * low, 100 * high, color=colour, alpha=0.15, linewidth=0)
        success.plot(trials, 100 * rate, color=colour, label=f"{name}, training")
        scores = [score for score in run.history.epochs if score.tally.judged[name]]
        if scores:
            at, rates = [score.trials for score in scores], [100 * score.tally.rate(name) for score in scores]
            spread = np.array([score.tally.interval(name) for score in scores]).T * 100
            bars = np.abs(spread - np.array(rates))
            success.errorbar(
                at, rates, bars, fmt="o", ms=3.5, mfc="white", elinewidth=0.8, color=colour, label=f"{name}, evaluation"
            )
    success.set(ylabel="success [%]", ylim=(0.0, 101.5), title=f"{run.spec.name}: {size} training trials at a time")
    success.legend(loc="lower right", fontsize=9, frameon=False)
    ends = _ends(len(run.costs), size)
    windows = [np.array(run.costs[max(end - size, 0) : end]) for end in ends]
    kept = [(end, values[~np.isnan(values)]) for end, values in zip(ends, windows, strict=True)]
    quantiles = np.array([[end, *np.quantile(values, [0.1, 0.5, 0.9])] for end, values in kept if len(values)])
    if len(quantiles):
        cost.fill_between(quantiles[:, 0], quantiles[:, 1], quantiles[:, 3], color="0.5", alpha=0.25, linewidth=0)
        cost.plot(quantiles[:, 0], quantiles[:, 2], color="black")
    cost.set(xlabel="training trials", ylabel="cost", ylim=(0.0, 1.02))
    for axes in (success, cost):
        axes.grid(alpha=0.3)
    save_figure(figure, path)


def _ends(count: int, size: int) -> list[int]:
    """Ends of windows of that size, the last of which is the end; at most `POINTS` and one."""
    first = min(size, count)
    return list(dict.fromkeys(int(end) for end in np.linspace(first, count, min(POINTS, count - first + 1))))


def _rates(marks: list[bool | None], size: int) -> tuple[Array, Array, Array, Array]:
    """Ends of windows, and in each the share of true marks with its 95 % interval; None marks do not count."""
    judged = [0, *accumulate(mark is not None for mark in marks)]
    good = [0, *accumulate(mark is True for mark in marks)]
    rows = []
    for end in _ends(len(marks), size):
        count, met = (sums[end] - sums[max(end - size, 0)] for sums in (judged, good))
        if count:
            rows.append((end, met / count, *wilson_interval(met, count)))
    ends, rate, low, high = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return ends, rate, low, high


def draw_coverage(run: Run, active: Array, path: Path) -> None:
    """Saves a figure of the tried states, the trials' results, and the active samples.

    Args:
        run: The task's trials.
        active: (k, d) states of the active samples.
        path: Where to.

    Raises:
        Invalid: There is no training trial.
    """
    if not run.states:
        raise Invalid(f"task {run.spec.name!r} has no training trial yet; start some: crkr workers")
    states, success = np.array(run.states[-SHOWN:]), np.array(run.success[-SHOWN:])
    varied = [place for place, axis in enumerate(run.spec.state) if np.ptp(states[:, place]) > 1e-6 * _width(axis)]
    shown = (varied or [0])[:AXES]
    size = 3.2 if len(shown) < 3 else 1.9
    figure = new_figure(max(size * len(shown), 4.5) + 0.6, max(size * len(shown), 4.0) + 0.8)
    panels = figure.subplots(len(shown), len(shown), squeeze=False)
    for row, up in enumerate(shown):
        for column, across in enumerate(shown):
            axes = panels[row, column]
            if column > row:
                axes.set_axis_off()
                continue
            if up == across:
                _spread(axes, run.spec.state[up], states[:, up], success)
            else:
                axes.scatter(*states[:, [across, up]].T, s=5, lw=0, alpha=0.55, c=np.where(success, GOOD, BAD))
                axes.scatter(*active[:, [across, up]].T, s=16, facecolors="none", edgecolors=ACTIVE, linewidths=0.8)
            axes.tick_params(labelsize=7)
            axes.set(
                xlabel=_label(run.spec.state[across]) if row == len(shown) - 1 else "",
                ylabel=_label(run.spec.state[up]) if column == 0 and row else "",
            )
    told = f"the newest {len(states)} of {len(run.states)}" if len(states) < len(run.states) else f"{len(states)}"
    handles = [
        figure.axes[0].scatter([], [], color=colour, facecolors=face, label=label)
        for colour, face, label in ((GOOD, GOOD, "success"), (BAD, BAD, "no success"), (ACTIVE, "none", "active"))
    ]
    figure.legend(handles=handles, loc="upper right", frameon=False)
    figure.suptitle(f"{run.spec.name}: {told} training trials, {len(active)} active samples", x=0.02, ha="left")
    save_figure(figure, path)


def _spread(axes: Any, axis: StateDimension, values: Array, success: NDArray[np.bool_]) -> None:
    """How many trials succeeded and failed along one coordinate, and its usual range."""
    axes.hist([values[success], values[~success]], bins=20, stacked=True, color=[GOOD, BAD])
    for end in (axis.low, axis.high):
        axes.axvline(end, color="0.6", linestyle=":", linewidth=1)


def _width(axis: StateDimension) -> float:
    return axis.high - axis.low


def _label(axis: StateDimension) -> str:
    return f"{axis.name} [{axis.unit}]" if axis.unit else axis.name
