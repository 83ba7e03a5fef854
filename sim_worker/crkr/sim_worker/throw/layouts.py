"""Where bin and wall stand, the numbers of the scene, and the distributions that trials draw them from.

scene.xml holds the same numbers, and a test compares them. Scene's frame: origin on the floor under the arm's base, x
towards the bin, y to the left, z up.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.simulation.flight import Air, drag_of

__all__ = [
    "AIR",
    "BALL_MASS",
    "BALL_RADIUS",
    "LAUNCHERS",
    "OPENING",
    "RIM",
    "WALL_HALF_THICKNESS",
    "WALL_HALF_WIDTH",
    "Launcher",
    "Layout",
]

BALL_RADIUS: Final = 0.0335  # a tennis ball's [m]
BALL_MASS: Final = 0.058  # [kg]
AIR: Final = Air(drag_of(BALL_RADIUS, BALL_MASS))
RIM: Final = 0.35  # height of the bin's opening [m]
OPENING: Final = 0.15  # half its inner width, in x and in y [m]
WALL_HALF_THICKNESS: Final = 0.02  # [m]
WALL_HALF_WIDTH: Final = 1.0  # [m]
NEAREST: Final = 0.3  # from the wall's middle to the bin's [m]
STEEPEST: Final = 1.5  # from the wall's top down to the bin's rim, height over distance
MOST_DRAWS: Final = 1000


@final
@dataclass(frozen=True, slots=True)
class Layout:
    """One situation.

    Attributes:
        bin_x: Middle of the bin's opening [m].
        bin_y: The same.
        wall_x: Middle of the wall, which stands across x [m].
        wall_height: Its top [m].
    """

    bin_x: float
    bin_y: float
    wall_x: float
    wall_height: float

    @classmethod
    def of(cls, state: Array) -> Layout:
        """The layout of a state (4,)."""
        return cls(*np.asarray(state, dtype=np.float64).tolist())

    @property
    def wall(self) -> Array:
        """(3,) middle of the wall's top edge [m]."""
        return np.array([self.wall_x, 0.0, self.wall_height])

    @property
    def bin(self) -> Array:
        """(3,) middle of the bin's opening [m]."""
        return np.array([self.bin_x, self.bin_y, RIM])

    @property
    def is_fair(self) -> bool:
        """Whether a ball that comes over the wall can reach the bin behind it."""
        behind = self.bin_x - self.wall_x
        return behind >= NEAREST and self.wall_height - RIM <= STEEPEST * behind


@final
@dataclass(frozen=True, slots=True)
class Launcher:
    """A distribution of situations: uniform, redrawn until fair.

    Attributes:
        name: The name that users choose.
        low: (4,) least state [m].
        high: (4,) greatest one [m].
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> Array:
        """A state (4,)."""
        for _ in range(MOST_DRAWS):
            state = rng.uniform(self.low, self.high)
            if Layout.of(state).is_fair:
                return np.asarray(state)
        raise RuntimeError(f"launcher {self.name}: none of {MOST_DRAWS} draws is fair; widen its ranges")


LAUNCHERS: Final[Mapping[str, Launcher]] = {
    launcher.name: launcher
    for launcher in (
        Launcher("nominal", low=(1.95, -0.4, 1.6, 0.5), high=(2.6, 0.4, 2.0, 1.1)),
        Launcher("wide", low=(1.95, -0.9, 1.6, 0.4), high=(2.8, 0.9, 2.3, 1.3)),
    )
}
