"""The learning curves of several runs in one figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from crkr.experiments.learning_run import LearningRun

__all__ = ["draw_learning"]


def draw_learning(runs: Sequence[LearningRun], oracle: Mapping[str, float], title: str, path: Path) -> None:
    """Saves mean, worst and best run of every criterion over the training trials, as the suffix of `path` says.

    Args:
        runs: At least one, watched.
        oracle: The planner's rates by criterion, drawn as lines; may be empty.
        title: Of the figure.
        path: E.g. learning.png.
    """
    figure = Figure(figsize=(7.0, 4.2), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    trials = [score.trials for score in runs[0].curve]
    for index, criterion in enumerate(runs[0].final.successes):
        rates = np.array([[score.rate(criterion) for score in run.curve] for run in runs])  # (runs, points)
        axes.plot(trials, rates.mean(axis=0), color=f"C{index}", marker=".", label=f"{criterion}, mean of {len(runs)}")
        axes.fill_between(trials, rates.min(axis=0), rates.max(axis=0), color=f"C{index}", alpha=0.15, linewidth=0)
        if criterion in oracle:
            axes.axhline(oracle[criterion], color=f"C{index}", linestyle=":", label=f"{criterion}, planner")
    axes.set(title=title, xlabel="training trials", ylabel="success rate", ylim=(0.0, 1.01))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path)
