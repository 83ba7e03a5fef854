"""A policy along one coordinate of the state: drawn by the skill if it can, else as the goals' coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path
from typing import Any, Final

import numpy as np

from crkr.protocol import Array, Invalid, Prediction, TaskSpec
from crkr.sim_worker.figure import new_figure, save_figure
from crkr.sim_worker.skill import HasPolicyFigure, Skill

__all__ = ["draw_policy", "varied"]

COLUMNS: Final = 4


def varied(spec: TaskSpec, name: str, points: int, base: Sequence[float] | None = None) -> tuple[int, Array]:
    """Index of the state's coordinate `name`, and states (points, d) in which only that coordinate varies over its box.

    Args:
        spec: Of the task.
        name: A coordinate of its state.
        points: How many states.
        base: (d,) values of the others; None is the middle of their boxes.

    Raises:
        Invalid: There is no such coordinate, or the base has another length.
    """
    names = [axis.name for axis in spec.state]
    if name not in names:
        raise Invalid(f"task {spec.name!r} has no state coordinate {name!r}; there are {', '.join(names)}")
    middle = [0.5 * (axis.low + axis.high) for axis in spec.state] if base is None else list(base)
    if len(middle) != len(names):
        raise Invalid(f"a state of task {spec.name!r} has {len(names)} numbers; got {len(middle)}")
    index = names.index(name)
    states = np.tile(np.array(middle, dtype=np.float64), (points, 1))
    states[:, index] = np.linspace(spec.state[index].low, spec.state[index].high, points)
    return index, states


def draw_policy(spec: TaskSpec, index: int, answer: Prediction, skill: Skill | None, path: Path) -> None:
    """Saves the figure.

    Args:
        spec: Of the task.
        index: Of the coordinate in which the states differ.
        answer: The policy's answer to the states.
        skill: The task's skill; None, or one that draws no policy, leaves the goals themselves.
        path: Where to.

    Raises:
        Invalid: The skill has other states or goals than the task.
    """
    rows = ceil(len(spec.goal) / COLUMNS)
    drawn = skill is not None and isinstance(skill, HasPolicyFigure)
    above = 5.0 if drawn else 2.0 * rows
    figure = new_figure(10.0, above + 2.0, dpi=110)
    parts: Any = figure.subfigures(2, 1, height_ratios=[above, 2.0])
    if skill is not None and isinstance(skill, HasPolicyFigure):
        _check_shape(skill.spec(), spec)
        skill.draw_policy(parts[0], answer.states, answer.goals, index)
    else:
        _draw_goals(parts[0], spec, index, answer)
    _draw_trust(parts[1], spec, index, answer)
    parts[0].suptitle(f"{spec.name}: policy over {spec.state[index].name}")
    save_figure(figure, path)


def _check_shape(mine: TaskSpec, theirs: TaskSpec) -> None:
    if (len(mine.state), len(mine.goal)) != (len(theirs.state), len(theirs.goal)):
        raise Invalid(f"task {theirs.name!r} has other states or goals than the skill; name its skill with --skill")


def _draw_goals(figure: Any, spec: TaskSpec, index: int, answer: Prediction) -> None:
    """Each coordinate of the goals with the policy's own deviation."""
    values = answer.states[:, index]
    panels = figure.subplots(ceil(len(spec.goal) / COLUMNS), COLUMNS, squeeze=False, sharex=True).ravel()
    for axes, entry, goals, sigmas in zip(panels, spec.goal, answer.goals.T, answer.sigmas.T, strict=False):
        axes.fill_between(values, goals - sigmas, goals + sigmas, alpha=0.2, linewidth=0)
        axes.plot(values, goals, color="black")
        axes.set_title(f"{entry.name} [{entry.unit}]" if entry.unit else entry.name, fontsize=9)
        axes.grid(alpha=0.3)
    for axes in panels[len(spec.goal) :]:
        axes.set_axis_off()


def _draw_trust(figure: Any, spec: TaskSpec, index: int, answer: Prediction) -> None:
    axis, values = spec.state[index], answer.states[:, index]
    chance = answer.success_probability
    shown = {"novelty": answer.novelty} | ({} if chance is None else {"probability of success": chance})
    for axes, (name, numbers) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
        axes.plot(values, numbers, color="black")
        axes.set(xlabel=f"{axis.name} [{axis.unit}]" if axis.unit else axis.name, ylabel=name, ylim=(0.0, 1.03))
        axes.grid(alpha=0.3)
