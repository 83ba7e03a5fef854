"""The outcome of a throw: where the ball passes wall and bin, the cost, and the reason of a failure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.simulation.flight import Ball
from crkr.sim_worker.throw.layouts import AIR, BALL_RADIUS, OPENING, RIM, WALL_HALF_THICKNESS, Layout

__all__ = ["COST_WIDTH", "Passage", "reason_of"]

# In contact a ball whose middle comes down less than 1 cm inside the rim, or up to 1 cm outside, may go either way.
CAUGHT: Final = OPENING - 0.01  # [m]
COST_WIDTH: Final = 0.1  # [m]; a miss by the half opening then costs 0.68


@final
@dataclass(frozen=True, slots=True)
class Passage:
    """Where a ball passes wall and bin in free flight.

    Attributes:
        miss: (2,) its centre minus the bin's as it comes down to the rim, x and y [m]; NaN if it never does.
        clearance: Least height of its lowest point over the wall's top edge [m], negative if it hits the wall; NaN if
            it never gets there.
        landing_time: Time at the rim [s]; None if it never gets there.
    """

    miss: Array
    clearance: float
    landing_time: float | None

    @classmethod
    def of(cls, ball: Ball, layout: Layout) -> Passage:
        """The passage of a ball in free flight."""
        # Followed below the floor, so that the miss of a short throw is measured.
        before = AIR.fly_to_x(ball, layout.wall_x - WALL_HALF_THICKNESS, floor=-np.inf)
        behind = None if before is None else AIR.fly_to_x(before[1], layout.wall_x + WALL_HALF_THICKNESS, floor=-np.inf)
        lowest = np.nan if before is None or behind is None else min(before[1].z, behind[1].z)
        start, time = ball, 0.0
        if before is not None and behind is not None and behind[1].z > RIM:
            start, time = behind[1], before[0] + behind[0]
        landing = AIR.fly_to_height(start, RIM)
        miss = np.full(2, np.nan) if landing is None else np.array(landing[1][:2]) - layout.bin[:2]
        clearance = float(lowest - BALL_RADIUS - layout.wall_height)
        return cls(miss, clearance, None if landing is None else time + landing[0])

    @property
    def is_clear(self) -> bool:
        """Whether the ball passes over the wall and falls into the bin."""
        return bool(self.clearance >= 0 and (np.abs(self.miss) <= CAUGHT).all())

    @property
    def cost(self) -> float:
        """In [0, 1]: saturates with the miss and the missing height over the wall; 1 if neither is known."""
        off = np.array([*self.miss, min(self.clearance, 0.0)])
        return 1.0 if np.isnan(off).any() else float(-np.expm1(-0.5 * (off @ off) / COST_WIDTH**2))


def reason_of(passage: Passage, inside: bool) -> str:
    """How a throw ended: "in", or "wall", "short", "long", "beside", "rim" (over the opening, yet not in)."""
    if inside:
        return "in"
    if not passage.clearance >= 0:
        return "wall"
    across, aside = passage.miss
    if not max(abs(across), abs(aside)) > OPENING:
        return "rim"
    if abs(aside) > abs(across):
        return "beside"
    return "short" if across < 0 else "long"
