"""Distributions of incoming balls: uniform launches, kept if fair, measured as they pass x = +0.5 m."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.table_tennis.ball.constants import (
    BALL_RADIUS,
    NET_TOP,
    SNAPSHOT_X,
    TABLE_FRICTION,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_HEIGHT,
    TABLE_RESTITUTION,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, bounce, fly_to_height, fly_to_x

__all__ = ["LAUNCHERS", "Launcher"]

BOUNCE_HEIGHT = TABLE_HEIGHT + BALL_RADIUS
# The bounce stays 15 cm from the net and 7 cm from the edges.

BOUNCE_X = (-TABLE_HALF_LENGTH + 0.07, -0.15)
BOUNCE_Y = TABLE_HALF_WIDTH - 0.07
MOST_DRAWS = 1000


@final
@dataclass(frozen=True, slots=True)
class Launcher:
    """A distribution of incoming balls.

    Attributes:
        name: The name that users choose.
        low: (6,) least launch position [m] and velocity [m/s].
        high: (6,) greatest ones.
        centre: (6,) mean of the snapshots [m, m/s].
        spread: (6,) standard deviation of the snapshots; 1 for the constant x.
    """

    name: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    centre: tuple[float, ...]
    spread: tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> Array:
        """The snapshot (6,) of one ball, position [m] and velocity [m/s]; unfair launches are redrawn."""
        for _ in range(MOST_DRAWS):
            snapshot = snapshot_of(Ball(*rng.uniform(self.low, self.high).tolist()))
            if snapshot is not None:
                return np.array(snapshot)
        raise RuntimeError(f"launcher {self.name}: none of {MOST_DRAWS} launches is fair; widen its ranges")


def snapshot_of(launch: Ball) -> Ball | None:
    """The ball at the snapshot; None unless it is fair: it clears the net and bounces once on the robot's side."""
    measured = fly_to_x(launch, SNAPSHOT_X)
    if measured is None or measured[1].z <= BOUNCE_HEIGHT or measured[1].vx >= 0:
        return None
    snapshot = measured[1]._replace(x=SNAPSHOT_X)
    over_net = fly_to_x(snapshot, 0.0)
    landing = fly_to_height(snapshot, BOUNCE_HEIGHT)
    if over_net is None or over_net[1].z <= NET_TOP + BALL_RADIUS or landing is None:
        return None
    ball = landing[1]
    if not (BOUNCE_X[0] <= ball.x <= BOUNCE_X[1] and abs(ball.y) <= BOUNCE_Y):
        return None
    return snapshot if _leaves_the_table(ball) else None


def _leaves_the_table(ball: Ball) -> bool:
    """Whether a ball that touches the table does so only once."""
    velocity, _ = bounce(
        np.array(ball[3:]),
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.zeros(3),
        restitution=TABLE_RESTITUTION,
        friction=TABLE_FRICTION,
        radius=BALL_RADIUS,
    )
    second = fly_to_height(Ball(ball.x, ball.y, BOUNCE_HEIGHT, *velocity.tolist()), BOUNCE_HEIGHT)
    return second is not None and (second[1].x < -TABLE_HALF_LENGTH or abs(second[1].y) > TABLE_HALF_WIDTH)


# Ranges: the skill's definition. Centre and spread: measured on 6000 launches.
LAUNCHERS: Final[Mapping[str, Launcher]] = {
    launcher.name: launcher
    for launcher in (
        Launcher(
            "nominal",
            low=(1.2, -0.25, 1.0, -5.3, -0.35, 1.0),
            high=(1.5, 0.25, 1.2, -4.6, 0.35, 1.7),
            centre=(0.5, 0.0, 1.185, -4.44, 0.0, -0.444),
            spread=(1.0, 0.148, 0.06, 0.185, 0.182, 0.252),
        ),
        Launcher(
            "medium",
            low=(1.2, -0.4, 1.0, -5.8, -0.6, 0.8),
            high=(1.5, 0.4, 1.25, -4.4, 0.6, 1.9),
            centre=(0.5, 0.0, 1.217, -4.596, 0.0, -0.38),
            spread=(1.0, 0.238, 0.078, 0.357, 0.312, 0.331),
        ),
        Launcher(
            "wide",
            low=(1.2, -0.6, 0.95, -6.5, -1.0, 0.5),
            high=(1.5, 0.6, 1.3, -4.2, 1.0, 2.2),
            centre=(0.5, 0.0, 1.227, -4.816, 0.0, -0.311),
            spread=(1.0, 0.319, 0.099, 0.562, 0.499, 0.412),
        ),
    )
}
