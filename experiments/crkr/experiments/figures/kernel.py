"""The kernel as a picture: two squared exponentials of different width, and their product  [Cardoso2017, fig. 3]."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from crkr.learner import Kernel
from crkr.sim_worker.figure import new_figure, save_figure

__all__ = ["draw_kernel"]

LENGTHSCALES: Final = (0.5, 1.5)
REACH: Final = 3.0  # of the axes, in the units of the state
POINTS: Final = 121


def draw_kernel(path: Path) -> None:
    """Saves the covariance of good goals between the state (0, 0) and those around it."""
    figure = new_figure(10.0, 3.4)
    single, double = figure.subplots(1, 2)
    offsets = np.linspace(-REACH, REACH, POINTS)
    for lengthscale, colour in zip(LENGTHSCALES, ("#0072b2", "#d55e00"), strict=True):
        kernel = Kernel(np.zeros(1), np.array([lengthscale]), 1.0)
        covariance = _row(kernel, offsets[:, None])
        single.plot(offsets, covariance, color=colour, label=f"length-scale {lengthscale:g}")
    single.set(xlabel="distance in one coordinate", ylabel="covariance", title="one coordinate each", ylim=(0, 1.05))
    single.grid(alpha=0.3)
    single.legend(loc="upper left", fontsize="small")
    both = Kernel(np.zeros(2), np.array(LENGTHSCALES), 1.0)
    first, second = np.meshgrid(offsets, offsets)
    covariance = _row(both, np.column_stack([first.ravel(), second.ravel()])).reshape(first.shape)
    shown = double.contourf(first, second, covariance, levels=np.linspace(0, 1, 11), cmap="viridis")
    figure.colorbar(shown, ax=double, label="covariance")
    double.set(
        xlabel=f"distance, length-scale {LENGTHSCALES[0]:g}",
        ylabel=f"distance, length-scale {LENGTHSCALES[1]:g}",
        title="both: their product",
        aspect="equal",
    )
    save_figure(figure, path)


def _row(kernel: Kernel, states: np.ndarray) -> np.ndarray:
    """Covariances (n,) of states (n, d) with the origin."""
    return kernel.matrix(kernel.standardise(states), kernel.standardise(np.zeros((1, states.shape[1]))))[:, 0]
