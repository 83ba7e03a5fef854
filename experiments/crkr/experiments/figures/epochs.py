"""Success by epoch, several ways of learning in one figure  [Cardoso2017, fig. 5 and 7]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from crkr.experiments.figures.learning import COLOURS
from crkr.experiments.learning.run import LearningRun
from crkr.sim_worker.figure import new_figure, save_figure

__all__ = ["draw_epochs"]


def draw_epochs(ways: Mapping[str, Sequence[LearningRun]], criterion: str, title: str, path: Path) -> None:
    """Saves mean, worst and best run of every way, and where each began to choose among its samples.

    Args:
        ways: Name -> its runs, with curves over the same trials.
        criterion: Which success is drawn.
        title: Of the figure.
        path: E.g. figure5.png.
    """
    figure = new_figure(7.0, 4.2)
    axes = figure.add_subplot()
    first = next(iter(ways.values()))
    trials = [score.trials for score in first[0].curve]
    for (name, runs), colour in zip(ways.items(), _colours(len(ways)), strict=True):
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


def _colours(count: int) -> list[str]:
    return [COLOURS[index % len(COLOURS)] for index in range(count)]
