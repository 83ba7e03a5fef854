"""Figure of throw goals: where the ball leaves the hand, and its flight."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.simulation.flight import Ball
from crkr.sim_worker.throw.layouts import AIR, OPENING, RIM, Layout
from crkr.sim_worker.throw.outcome import Passage
from crkr.sim_worker.throw.planner import full_goal

__all__ = ["draw_throws"]

INTERVAL: Final = 0.02  # [s]
SPARSE: Final = 5  # wall and bin are drawn for one state in this many, or they would cover each other
WITHOUT_LANDING: Final = 1.0  # drawn part of a flight that never comes down to the rim [s]


def draw_throws(figure: Any, arm: Arm, label: str, values: Array, states: Array, goals: Array) -> None:
    """Draws the flights of ideal releases from the side and from above, with each state's wall and bin.

    Args:
        figure: An empty Matplotlib figure.
        arm: Its kinematics.
        label: Of the state's coordinate that varies.
        values: (n,) of that coordinate.
        states: (n, 4).
        goals: (n, 8).
    """
    from matplotlib import colormaps

    side, above = figure.subplots(1, 2)
    shares = (values - values.min()) / max(float(np.ptp(values)), 1e-12)
    for place, (state, goal, share) in enumerate(zip(states, goals, shares.tolist(), strict=True)):
        colour, layout = colormaps["viridis"](share), Layout.of(state)
        path = _path(arm, goal, layout)
        side.plot(path[:, 0], path[:, 2], color=colour, linewidth=1)
        above.plot(path[:, 0], path[:, 1], color=colour, linewidth=1)
        if place % SPARSE:
            continue
        side.plot([layout.wall_x] * 2, [0.0, layout.wall_height], color=colour, linewidth=3, alpha=0.5)
        x, y = layout.bin[:2]
        side.plot([x - OPENING, x + OPENING], [RIM, RIM], color=colour, linewidth=2)
        corners = OPENING * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) + [x, y]
        above.plot(*corners.T, color=colour, linewidth=1)
    shown = side.scatter([], [], c=[], vmin=values.min(), vmax=values.max(), cmap="viridis")
    figure.colorbar(shown, ax=[side, above], label=label, location="bottom", shrink=0.6, aspect=50)
    side.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
    above.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    side.set_title("the ball from its release on, wall and rim of the bin", fontsize=9)
    above.set_title("from above", fontsize=9)
    for axes in (side, above):
        axes.grid(alpha=0.3)


def _path(arm: Arm, goal: Array, layout: Layout) -> Array:
    """(n, 3) of a ball that leaves the hand ideally, down to the rim."""
    position, speed, _ = full_goal(goal)
    grip = arm.tool(position, speed)
    ball = Ball(*grip.position.tolist(), *grip.velocity.tolist())
    return AIR.path(ball, Passage.of(ball, layout).landing_time or WITHOUT_LANDING, INTERVAL)[1]
