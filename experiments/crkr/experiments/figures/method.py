"""Figures of the method, without a simulator.

The kernel: two squared exponentials of different width, and their product  [Cardoso2017, fig. 3]. And how exploration
narrows, on a task of one state and one goal  [Cardoso2017, fig. 4].
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner import Kernel, Learner
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.figure import new_figure, save_figure

__all__ = ["Moment", "draw_exploration", "draw_kernel", "exploration_moments"]

LENGTHSCALES: Final = (0.5, 1.5)
REACH: Final = 3.0  # of the axes, in the units of the state
POINTS: Final = 121
ITERATIONS: Final = (0, 5, 50)
WIDTH: Final = 0.6  # a of [Cardoso2017, eq. 8], in units of the goal
SHOWN: Final = 201  # states of a curve


def draw_kernel(path: Path) -> None:
    """Save the covariance of good goals between the state (0, 0) and those around it."""
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


@final
@dataclass(frozen=True, slots=True)
class Moment:
    """The policy after some iterations.

    Attributes:
        iterations: Exploration trials so far.
        states: (n,) of the samples, the demonstration first.
        goals: (n,) of the samples.
        costs: (n,) in [0, 1].
        shown: (SHOWN,) states of the curves.
        mean: (SHOWN,) the policy.
        sigma: (SHOWN,) its exploration noise, one standard deviation.
    """

    iterations: int
    states: Array
    goals: Array
    costs: Array
    shown: Array
    mean: Array
    sigma: Array


def best_goal(state: Array) -> Array:
    """The goal (n,) that costs nothing in each state; the learner does not know it."""
    return np.sin(state) + 0.3 * state


def exploration_moments(seed: int) -> list[Moment]:
    """The moments after `ITERATIONS` trials, each in a random state with a goal drawn by the policy."""
    learner = Learner(_specification(seed))
    rng = np.random.default_rng(seed)
    moments = []
    for trial in range(max(ITERATIONS) + 1):
        if trial == 0:
            state = np.array([3.0])
            learner.report(state=state, goal=best_goal(state), cost=0.0, success=True, kind="demonstration")
        else:
            answer = learner.predict(rng.uniform(0.0, 10.0, 1), explore=True, trial_ids=UUID(bytes=rng.bytes(16)))
            missed = answer.goal - best_goal(answer.state)
            cost = float(1.0 - np.exp(-(missed @ missed) / (2.0 * WIDTH**2)))
            learner.report(answer, cost=cost, success=cost < 0.5)
        if trial in ITERATIONS:
            moments.append(_moment(learner, trial))
    return moments


def _specification(seed: int) -> TaskSpec:
    state = {"name": "state", "low": 0.0, "high": 10.0, "lengthscale": 1.5}
    goal = {"name": "goal", "low": -6.0, "high": 9.0, "scale": 1.0}
    fields: dict[str, Any] = {"name": "narrowing", "state": [state], "goal": [goal], "seed": seed}
    return TaskSpec.from_dict({**fields, "learn_from": "all", "cost_map": "odds", "noise_floor": 1e-3})


def _moment(learner: Learner, iterations: int) -> Moment:
    shown = np.linspace(0.0, 10.0, SHOWN)
    answer, model = learner.predict(shown[:, None]), learner.model
    return Moment(
        iterations, model.states[:, 0], model.goals[:, 0], model.costs, shown, answer.means[:, 0], answer.sigmas[:, 0]
    )


def draw_exploration(moments: list[Moment], path: Path) -> None:
    """Save one panel for each moment: the policy, its noise, and the trials with their costs as bars."""
    figure = new_figure(4.0 * len(moments), 3.6)
    panels = figure.subplots(1, len(moments), sharey=True, squeeze=False)[0]
    for panel, moment in zip(panels, moments, strict=True):
        low, high = moment.mean - moment.sigma, moment.mean + moment.sigma
        panel.fill_between(
            moment.shown, low, high, color="#f4a6c0", alpha=0.6, linewidth=0, label="exploration, ±1 sigma"
        )
        panel.plot(
            moment.shown, best_goal(moment.shown), color="0.4", linestyle="--", label="best goals, unknown to it"
        )
        panel.plot(moment.shown, moment.mean, color="#0072b2", label="policy")
        bars = {"fmt": "o", "color": "black", "markersize": 3, "elinewidth": 1, "capsize": 2}
        panel.errorbar(moment.states, moment.goals, yerr=moment.costs, label="trials, bars: cost", **bars)
        after = f"and {moment.iterations} trials" if moment.iterations else "alone"
        panel.set(title=f"after a demonstration {after}", xlabel="state", xlim=(0, 10))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("goal")
    panels[0].legend(loc="upper left", fontsize="small")
    save_figure(figure, path)
