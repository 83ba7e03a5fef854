"""Draws success by epoch, with its uncertainty, into a PNG."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from crkr.sim_worker.evaluation.run_history import RunHistory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_learning_curve"]

# Distinguishable without colour vision, and in this order for the usual criteria.
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")


def draw_learning_curve(history: RunHistory, title: str, budget: int, path: Path) -> bool:
    """Writes the figure; returns False, without a file, if no epoch was judged."""
    if not history.epochs:
        return False
    from crkr.sim_worker.figure import mpl, new_figure, save_figure

    with mpl.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure = new_figure(8.0, 4.5)
        axes = figure.add_subplot()
        _curves(axes, history)
        _budget(axes, history, budget)
        axes.set(title=title, xlabel="training trials", ylabel="success on the fixed contexts [%]", ylim=(0.0, 101.0))
        axes.grid(alpha=0.25)
        # Outside, since no corner of the axes is free in every run.
        figure.legend(loc="outside lower center", ncols=len(COLOURS), frameon=False)
        save_figure(figure, path)
    return True


def _curves(axes: Axes, history: RunHistory) -> None:
    names = dict.fromkeys(name for score in history.epochs for name in score.tally.criteria)
    for name, colour in zip(names, COLOURS, strict=False):
        epochs = [score for score in history.epochs if score.tally.judged[name]]
        trials = [score.trials for score in epochs]
        bands = [score.tally.interval(name) for score in epochs]
        axes.fill_between(
            trials, [100 * low for low, _ in bands], [100 * high for _, high in bands], color=colour, alpha=0.15, lw=0
        )
        rates = [100 * score.tally.rate(name) for score in epochs]
        axes.plot(trials, rates, color=colour, marker="o", markersize=3, label=f"{name} criterion")


def _budget(axes: Axes, history: RunHistory, budget: int) -> None:
    if history.filled_at is None:
        return
    axes.axvline(history.filled_at, color="0.4", linestyle="--", linewidth=1)
    late = history.filled_at > sum(axes.get_xlim()) / 2  # then the text goes to the left of the line
    axes.annotate(
        f"active set full ({budget})",
        (history.filled_at, 3.0),
        xytext=(-5 if late else 5, 0),
        textcoords="offset points",
        ha="right" if late else "left",
        color="0.3",
    )
