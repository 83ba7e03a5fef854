"""Figure of table tennis goals: where, when and how the paddle would meet the ball."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.table_tennis.ball.constants import TABLE_HALF_LENGTH, TABLE_HEIGHT

__all__ = ["draw_hits"]

STRIDE: Final = 0.05  # how far an arrow shows the paddle's motion [s]


def draw_hits(figure: Any, arm: Arm, label: str, values: Array, goals: Array) -> None:
    """Draws the paddles of goals (n, 13), from above and from the side, and the times of the hits.

    Args:
        figure: An empty Matplotlib figure.
        arm: Its kinematics.
        label: Of the state's coordinate that varies.
        values: (n,) of that coordinate.
        goals: (n, 13).
    """
    paddles = [arm.tool(goal[:6], goal[6:12]) for goal in goals]
    above, side, time = figure.subplots(1, 3, width_ratios=[2, 2, 1])
    for axes, vertical, height in ((above, 1, "y [m]"), (side, 2, "z [m]")):
        plane = [0, vertical]
        centres, ways, normals = (
            np.array([getattr(paddle, name) for paddle in paddles])[:, plane]
            for name in ("position", "velocity", "normal")
        )
        ways = STRIDE * ways
        axes.update_datalim(np.vstack([centres + 1.5 * ways, centres - 0.5 * ways]))
        axes.quiver(*centres.T, *ways.T, values, angles="xy", scale_units="xy", scale=1, width=0.004)
        faces = np.stack([-normals[:, 1], normals[:, 0]], axis=1) * 0.08  # across the normal, blade-sized
        blades = np.stack([centres - faces, centres + faces]).transpose(2, 0, 1)
        axes.plot(*blades, color="0.7", linewidth=1, zorder=0)
        shown = axes.scatter(*centres.T, c=values, s=14)
        axes.set(xlabel="x [m]", ylabel=height, aspect="equal", adjustable="datalim")
    above.set_title("paddle from above; arrows: its way in 50 ms", fontsize=9)
    side.set_title("from the side; grey: its face, blue: the table's end", fontsize=9)
    side.plot([-TABLE_HALF_LENGTH, -TABLE_HALF_LENGTH + 0.15], [TABLE_HEIGHT] * 2, color="navy", linewidth=3)
    figure.colorbar(shown, ax=[above, side], label=label)
    time.plot(values, goals[:, 12], color="black")
    time.set(xlabel=label, ylabel="hit time [s]")
    for axes in (above, side, time):
        axes.grid(alpha=0.3)
