"""Learning curves: several runs of one way of learning, or several ways  [Cardoso2017, fig. 5 and 7]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.experiments.learning.run import LearningRun
from crkr.sim_worker.figure import new_figure, save_figure

__all__ = ["draw_epochs", "draw_gains", "draw_learning", "draw_summaries"]

COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # the colour-blind can tell them
EARLY: Final = 50  # trials up to which the horizontal axis is linear
DASH: Final = 3.0  # [points]


def draw_learning(runs: Sequence[LearningRun], oracle: Mapping[str, float], title: str, path: Path) -> None:
    """Save mean, worst and best run by each criterion over the training trials; `path` has the format as its suffix.

    Args:
        runs: At least one, with curves.
        oracle: The planner's rates by criterion, drawn as dashed lines; may be empty.
        title: Of the figure.
        path: E.g. learning.png.
    """
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    shown: list[tuple[Any, str]] = []
    trials = [score.trials for score in runs[0].curve]
    for index, criterion in enumerate(runs[0].final.tally.criteria):
        colour = COLOURS[index % len(COLOURS)]
        rates = np.array([[score.tally.rate(criterion) for score in run.curve] for run in runs])  # (runs, points)
        what = f"{criterion}: mean and range of {len(runs)} runs" if len(runs) > 1 else f"{criterion}: one run"
        band = axes.fill_between(trials, rates.min(axis=0), rates.max(axis=0), color=colour, alpha=0.2, linewidth=0)
        (line,) = axes.plot(trials, rates.mean(axis=0), color=colour, marker=".")
        shown.append(((band, line), what))
        if criterion in oracle:
            # The planner's rates are often equal: each line has its dashes in the gaps of the one before.
            dashes = (DASH * index, (DASH, DASH * (len(oracle) - 1) or DASH))
            planned = axes.axhline(oracle[criterion], color=colour, linestyle=dashes)
            shown.append((planned, f"{criterion}: planner, {oracle[criterion]:.3f}"))
    contexts = runs[0].curve[0].contexts
    axes.set(title=title, ylabel=f"success rate in {contexts} contexts", ylim=(0.0, 1.01))
    axes.set_xscale("symlog", linthresh=EARLY, linscale=0.7)  # much is learned early
    ticks = _apart(trials)
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set(xlabel=f"training trials, logarithmic from {EARLY}", xlim=(0, trials[-1]))
    axes.grid(alpha=0.3)
    axes.legend(*zip(*shown, strict=True), loc="lower right")
    save_figure(figure, path)


def _apart(trials: Sequence[int]) -> list[int]:
    """The trials whose labels have room, with the last one."""
    ticks: list[int] = []
    for trial in reversed(trials):
        if not ticks or trial < EARLY or ticks[-1] > 1.4 * trial:
            ticks.append(trial)
    return ticks


def draw_epochs(ways: Mapping[str, Sequence[LearningRun]], criterion: str, title: str, path: Path) -> None:
    """Save mean, worst and best run of every way of learning, and when each had more samples than its budget.

    Args:
        ways: Name -> its runs, with curves over the same trials.
        criterion: The criterion of success.
        title: Of the figure.
        path: E.g. figure5.png.
    """
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    first = next(iter(ways.values()))
    trials = [score.trials for score in first[0].curve]
    for (name, runs), colour in zip(ways.items(), cycle(COLOURS), strict=False):
        rates = np.array([[score.tally.rate(criterion) for score in run.curve] for run in runs])  # (runs, epochs)
        axes.fill_between(trials, rates.min(axis=0), rates.max(axis=0), color=colour, alpha=0.12, linewidth=0)
        axes.plot(trials, rates.mean(axis=0), color=colour, label=f"{name}: {rates[:, -1].mean():.2f} in the end")
        filled = [run.filled for run in runs if run.filled is not None]
        if len(filled) == len(runs):
            axes.axvline(float(np.mean(filled)), color=colour, linestyle=":", linewidth=1.2)
    axes.plot([], [], color="0.3", linestyle=":", label="from here on, more samples than the budget")
    axes.set(title=title, xlabel="training trials", ylim=(0.0, 1.01), xlim=(0, trials[-1]))
    axes.set_ylabel(f"success rate ({criterion}) in {first[0].curve[0].contexts} fixed contexts")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right", title=f"mean and range of {len(first)} runs", fontsize="small")
    save_figure(figure, path)


def draw_summaries(table: Sequence[Mapping[str, Any]], title: str, path: Path) -> None:
    """Save each way's interquartile mean with its 95 % interval over the training trials.

    Args:
        table: Rows of `study.rows.summary_table`, each judged after more than 0 trials.
        title: Of the figure.
        path: E.g. rivals.png.
    """
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    ticks = sorted({mark for row in table for mark in row["marks"]})
    styles = [(colour, mark) for mark in ("o-", "s--", "^:") for colour in COLOURS]
    for row, (colour, style) in zip(table, cycle(styles), strict=False):
        trials, found = list(row["marks"]), list(row["marks"].values())
        mean = np.array([one.mean for one in found])
        reach = np.array([[one.mean - one.low for one in found], [one.high - one.mean for one in found]])
        axes.errorbar(
            trials, mean, np.maximum(reach, 0), fmt=style, color=colour, capsize=3, markersize=4, label=row["way"]
        )
    axes.set(title=title, xlabel="training trials, logarithmic", ylabel="success rate", ylim=(0.0, 1.01))
    axes.set_xscale("log")
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
    save_figure(figure, path)


def draw_gains(gains: Mapping[str, tuple[float, float, float]], title: str, path: Path) -> None:
    """Save the gain of each way over what it is compared with, and its 95 % interval.

    Args:
        gains: Name -> gain in success rate and the ends of its interval, from top to bottom.
        title: Of the figure.
        path: E.g. ablation.png.
    """
    figure = new_figure(7.0, 0.9 + 0.24 * len(gains))
    axes = figure.add_subplot()
    mean, low, high = np.array(list(gains.values())).T
    rows = np.arange(len(gains))
    apart = (low > 0) | (high < 0)
    for chosen, colour in ((~apart, "0.55"), (apart, COLOURS[0])):
        reach = np.maximum([mean - low, high - mean], 0)[:, chosen]
        axes.errorbar(mean[chosen], rows[chosen], xerr=reach, color=colour, fmt="o", markersize=4, capsize=2)
    axes.axvline(0.0, color="0.3", linewidth=0.8)
    axes.set(title=title, xlabel="gain in success rate, 95 % interval; grey where it includes 0")
    axes.set_yticks(rows, list(gains))
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    save_figure(figure, path)
