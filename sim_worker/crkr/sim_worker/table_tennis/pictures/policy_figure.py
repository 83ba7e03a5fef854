"""A policy in Cartesian space: where and how the paddle would meet the ball as one coordinate of the state varies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.arm.dynamics import ToolPose
from crkr.sim_worker.table_tennis.ball.constants import TABLE_HALF_LENGTH, TABLE_HEIGHT
from crkr.sim_worker.table_tennis.scene import make_arm

__all__ = ["draw_policy", "varied"]

Floats = NDArray[np.float64]

GOALS: Final = 13  # of the skill: six positions, six speeds, one time
STRIDE: Final = 0.05  # how far an arrow shows the paddle's motion [s]


def varied(spec: TaskSpec, name: str, points: int, base: Sequence[float] | None = None) -> tuple[int, Floats]:
    """Index of the state's coordinate `name`, and states (points, d) in which only that coordinate varies over its box.

    Args:
        spec: Of the task.
        name: A coordinate of its state.
        points: How many states.
        base: (d,) values of the others; None is the middle of their boxes.

    Raises:
        Invalid: There is no such coordinate, the base has another length, or the goals are not those of table tennis.
    """
    names = [axis.name for axis in spec.state]
    if name not in names:
        raise Invalid(f"task {spec.name!r} has no state coordinate {name!r}; there are {', '.join(names)}")
    if len(spec.goal) != GOALS:
        raise Invalid(
            f"task {spec.name!r} has {len(spec.goal)} goals; the figure is for table tennis, which has {GOALS}"
        )
    middle = [0.5 * (axis.low + axis.high) for axis in spec.state] if base is None else list(base)
    if len(middle) != len(names):
        raise Invalid(f"a state of task {spec.name!r} has {len(names)} numbers; got {len(middle)}")
    index = names.index(name)
    states = np.tile(np.array(middle, dtype=np.float64), (points, 1))
    states[:, index] = np.linspace(spec.state[index].low, spec.state[index].high, points)
    return index, states


@final
class _Hits:
    """Paddles at the hit for goals (n, 13), and the times of the hits (n,) [s]."""

    def __init__(self, goals: Floats) -> None:
        arm = make_arm()
        paddles: list[ToolPose] = [arm.tool(goal[:6], goal[6:12]) for goal in goals]
        self.centres = np.array([paddle.position for paddle in paddles])
        self.velocities = np.array([paddle.velocity for paddle in paddles])
        self.normals = np.array([paddle.normal for paddle in paddles])
        self.times = goals[:, 12]


def draw_policy(spec: TaskSpec, index: int, states: Floats, goals: Floats, novelty: Floats, path: Path) -> None:
    """Saves the figure; goals (n, 13) and novelty (n,) answer `states` (n, d), which differ in coordinate `index`."""
    from crkr.sim_worker.figure import new_figure, save_figure

    hits, axis, values = _Hits(goals), spec.state[index], states[:, index]
    figure = new_figure(10.0, 6.4, dpi=110)
    above, side, time, unsure = figure.subplots(2, 2).ravel()
    for axes, vertical, label in ((above, 1, "y [m]"), (side, 2, "z [m]")):
        shown = _paddles(axes, hits, values, vertical)
        axes.set(xlabel="x [m]", ylabel=label, aspect="equal", adjustable="datalim")
    above.set_title("paddle from above; arrows: its way in 50 ms")
    side.set_title("from the side; grey: its face, blue: the table's end")
    side.plot([-TABLE_HALF_LENGTH, -TABLE_HALF_LENGTH + 0.15], [TABLE_HEIGHT] * 2, color="navy", linewidth=3)
    figure.colorbar(shown, ax=[above, side], label=f"{axis.name} [{axis.unit}]")
    time.plot(values, hits.times, color="black")
    time.set(xlabel=f"{axis.name} [{axis.unit}]", ylabel="hit time [s]")
    unsure.plot(values, novelty, color="black")
    unsure.set(xlabel=f"{axis.name} [{axis.unit}]", ylabel="novelty", ylim=(0.0, 1.0))
    for axes in (above, side, time, unsure):
        axes.grid(alpha=0.3)
    figure.suptitle(f"{spec.name}: policy over {axis.name}")
    save_figure(figure, path)


def _paddles(axes: Any, hits: _Hits, values: Floats, vertical: int) -> Any:
    """Draws the paddles in the plane of x and another coordinate, coloured by value; returns the coloured points."""
    plane = [0, vertical]
    centres, ways = hits.centres[:, plane], STRIDE * hits.velocities[:, plane]
    axes.update_datalim(np.vstack([centres + 1.5 * ways, centres - 0.5 * ways]))
    axes.quiver(*centres.T, *ways.T, values, angles="xy", scale_units="xy", scale=1, width=0.004)
    faces = np.stack([-hits.normals[:, vertical], hits.normals[:, 0]], axis=1) * 0.08  # across the normal, blade-sized
    axes.plot(*np.stack([centres - faces, centres + faces]).transpose(2, 0, 1), color="0.7", linewidth=1, zorder=0)
    return axes.scatter(*centres.T, c=values, s=14)
