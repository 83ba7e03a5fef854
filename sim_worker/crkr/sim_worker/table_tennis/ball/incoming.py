"""The incoming ball without a simulator: exact flight pieces between rigid bounces on the table."""

from __future__ import annotations

from typing import Final, final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.simulation.simulation import Diverged
from crkr.sim_worker.table_tennis.ball.constants import (
    BALL_RADIUS,
    TABLE_FRICTION,
    TABLE_HALF_LENGTH,
    TABLE_HALF_WIDTH,
    TABLE_HEIGHT,
    TABLE_RESTITUTION,
)
from crkr.sim_worker.table_tennis.ball.flight import STEP, Ball, Curl, bounce, curl_of, fly, fly_to_height

__all__ = ["FreeBall", "Incoming"]

FASTEST: Final = 300.0  # [m/s]; from there on drag is stiffer than the integration's steps can follow
UP: Final = np.array([0.0, 0.0, 1.0])
TOUCH_HEIGHT: Final = TABLE_HEIGHT + BALL_RADIUS


@final
class Incoming:
    """The flight of a ball that is not hit, for `duration` [s] from its snapshot (6,), without spin at first.

    Args:
        snapshot: (6,) position [m] and velocity [m/s].
        duration: [s].
        magnus: Whether its spin lifts it.

    Attributes:
        bounces: Times of its bounces on the table [s].

    Raises:
        Diverged: A snapshot that is not finite or faster than `FASTEST`.
    """

    def __init__(self, snapshot: Array, duration: float, *, magnus: bool = False) -> None:
        if not (np.isfinite(snapshot).all() and np.linalg.norm(snapshot[3:]) <= FASTEST):
            raise Diverged(f"no ball flies like this: position and velocity {snapshot.tolist()}")
        self._magnus = magnus
        time, ball, spin = 0.0, Ball(*snapshot.tolist()), np.zeros(3)
        times, states, spins = [time], [ball], [spin]
        self.bounces: list[float] = []
        while time < duration:
            landing = fly_to_height(ball, TOUCH_HEIGHT, self.curl(spin)) if ball.z >= TOUCH_HEIGHT else None
            on_table = landing is not None and _over_table(landing[1])
            end = time + landing[0] if landing is not None and on_table else np.inf
            while time < min(end, duration):
                step = min(STEP, end - time)
                time, ball = time + step, fly(ball, step, self.curl(spin))
                times.append(time)
                states.append(ball)
                spins.append(spin)
            if time >= end:
                ball, spin = _off_table(ball, spin)
                self.bounces.append(time)
                times.append(time)
                states.append(ball)
                spins.append(spin)
        self._times, self._spins = np.array(times), spins
        self._balls = states
        self._states = np.array(states)  # (k, 6)

    def positions(self, times: Array) -> Array:
        """Positions (m, 3) [m] at `times` (m,), cubic between integration steps: exact to 1e-7 m."""
        after = np.clip(np.searchsorted(self._times, times, side="right"), 1, len(self._times) - 1)
        begin, end = self._states[after - 1], self._states[after]
        span = np.maximum(self._times[after] - self._times[after - 1], 1e-12)[:, None]
        u = (times - self._times[after - 1])[:, None] / span
        rise = u * u * (3 - 2 * u)
        slopes = u * (1 - u) ** 2 * begin[:, 3:] - u * u * (1 - u) * end[:, 3:]
        return np.asarray(begin[:, :3] + rise * (end[:, :3] - begin[:, :3]) + span * slopes)

    def at(self, time: float) -> tuple[Ball, Array]:
        """The ball and its spin (3,) [rad/s] at one time."""
        before = max(int(np.searchsorted(self._times, time, side="right")) - 1, 0)
        spin = self._spins[before]
        return fly(self._balls[before], time - float(self._times[before]), self.curl(spin)), spin

    def curl(self, spin: Array) -> Curl:
        """The lift of this ball while it has `spin` (3,) [rad/s]; None where spin does not lift it."""
        return curl_of(spin) if self._magnus else None


@final
class FreeBall:
    """Predicts incoming balls for the planner, as `BallAlone` does in simulation.

    Args:
        magnus: Whether a spinning ball is lifted.
    """

    timestep: Final = 0.001  # [s]

    def __init__(self, *, magnus: bool = False) -> None:
        self._magnus = magnus

    def path(self, ball: Array, duration: float) -> Array:
        """Position [m], velocity [m/s] and spin [rad/s] (n + 1, 9), table frame, every timestep from `ball` (6,) on."""
        incoming = Incoming(ball, duration, magnus=self._magnus)
        steps = int(np.ceil(duration / self.timestep))
        rows = (incoming.at(row * self.timestep) for row in range(steps + 1))
        return np.array([[*state, *spin] for state, spin in rows])


def _over_table(ball: Ball) -> bool:
    return bool(abs(ball.x) <= TABLE_HALF_LENGTH and abs(ball.y) <= TABLE_HALF_WIDTH)


def _off_table(ball: Ball, spin: Array) -> tuple[Ball, Array]:
    velocity, spin = bounce(
        np.array(ball[3:]),
        spin,
        UP,
        np.zeros(3),
        restitution=TABLE_RESTITUTION,
        friction=TABLE_FRICTION,
        radius=BALL_RADIUS,
    )
    # Slightly above the table, so that this landing is not found again.
    return Ball(ball.x, ball.y, TOUCH_HEIGHT + 1e-12, *velocity.tolist()), spin
