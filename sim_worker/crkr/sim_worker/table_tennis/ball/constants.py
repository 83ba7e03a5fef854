"""Numbers of the game that formulas need; scene.xml holds the same ones, and a test compares them.

Table, net and ball: International Table Tennis Federation, The Laws of Table Tennis, 2.1 to 2.3 [ITTF]. Restitution on
the table follows from the 23 to 26 cm that a ball must bounce from 30 cm, in air; friction and the paddle's values are
of the usual size and our choice.
Table frame: origin on the floor under the table's centre, x towards the opponent, y to the robot's left, z up.
"""

from __future__ import annotations

from typing import Final

from crkr.sim_worker.simulation.flight import GRAVITY, drag_of

__all__ = [
    "AIM",
    "BALL_MASS",
    "BALL_RADIUS",
    "DRAG",
    "FACE_OFFSET",
    "GRAVITY",
    "MAGNUS",
    "NET_HALF_LENGTH",
    "NET_TOP",
    "PADDLE_FRICTION",
    "PADDLE_HALF_THICKNESS",
    "PADDLE_RADIUS",
    "PADDLE_RESTITUTION",
    "SNAPSHOT_X",
    "SPIN_INERTIA",
    "TABLE_FRICTION",
    "TABLE_HALF_LENGTH",
    "TABLE_HALF_WIDTH",
    "TABLE_HEIGHT",
    "TABLE_RESTITUTION",
]

TABLE_HALF_LENGTH: Final = 1.37  # [m]
TABLE_HALF_WIDTH: Final = 0.7625  # [m]
TABLE_HEIGHT: Final = 0.76  # [m]
TABLE_RESTITUTION: Final = 0.93
TABLE_FRICTION: Final = 0.2
NET_TOP: Final = TABLE_HEIGHT + 0.1525  # [m]
NET_HALF_LENGTH: Final = 0.915  # [m]

BALL_RADIUS: Final = 0.02  # [m]
BALL_MASS: Final = 0.0027  # [kg]
SPIN_INERTIA: Final = 2 / 3  # moment of inertia over m r^2: a thin shell
DRAG: Final = drag_of(BALL_RADIUS, BALL_MASS)  # [1/m]
# Lift of a spinning ball, off unless asked for: a lift coefficient equal to the spin parameter r omega / v, which is of
# the usual size and our choice. The acceleration is MAGNUS * spin x velocity.
MAGNUS: Final = 0.5 * 1.2 * 3.141592653589793 * BALL_RADIUS**3 / BALL_MASS

PADDLE_RADIUS: Final = 0.08  # [m]
PADDLE_HALF_THICKNESS: Final = 0.006  # [m]
PADDLE_RESTITUTION: Final = 0.8
PADDLE_FRICTION: Final = 0.5
FACE_OFFSET: Final = (
    PADDLE_HALF_THICKNESS + BALL_RADIUS
)  # centre of a touching ball from the paddle's centre, along the normal [m]

SNAPSHOT_X: Final = 0.5  # where the incoming ball is measured [m]
AIM: Final = (0.75, 0.0)  # where a return should land, x and y [m]
