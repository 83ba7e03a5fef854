"""Everything by contact simulation: arm, ball, table and paddle in MuJoCo."""

from __future__ import annotations

from typing import final

import numpy as np

from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import Arm, tracking_controls
from crkr.sim_worker.primitives.joint_motion import JointTrajectory
from crkr.sim_worker.simulation.simulation import (
    ARM_POSITION,
    ARM_VELOCITY,
    BALL_POSITION,
    BALL_ROTATION,
    BALL_SPIN,
    BALL_VELOCITY,
    Recording,
    Simulation,
    rotated,
)
from crkr.sim_worker.table_tennis.ball.flight import Ball, Curl, curl_of, flight
from crkr.sim_worker.table_tennis.environments.play import FOLLOW, Play

__all__ = ["ContactEnvironment"]

PARTING = 0.02  # added while ball and paddle are still in contact [s]
MOST_PARTINGS = 5


@final
class ContactEnvironment:
    """Executes swings in the contact simulation; the same ball and swing give the same bits."""

    def __init__(self, arm: Arm, simulation: Simulation, *, magnus: bool = False) -> None:
        self._arm = arm
        self._simulation = simulation
        self._magnus = magnus

    def play(self, ball: Array, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: The simulator broke down.
        """
        step = self._simulation.timestep
        steps = int(np.ceil((hit_time + FOLLOW) / step))
        extra = int(PARTING / step)
        times = np.arange(steps + MOST_PARTINGS * extra, dtype=np.float64) * step
        controls = tracking_controls(self._arm, self._simulation.gains, swing, times)
        record = self._simulation.run(self._simulation.start(swing.position[0], ball), controls[:steps])
        for _ in range(MOST_PARTINGS):
            if not record.touching[-1]:
                break
            done = len(record.touching)
            more = self._simulation.run(record.states[-1], controls[done : done + extra])
            record = Recording(
                np.concatenate([record.states, more.states[1:]]), np.concatenate([record.touching, more.touching])
            )
        return self._measured(record, hit_time)

    def _measured(self, record: Recording, hit_time: float) -> Play:
        step, states = self._simulation.timestep, record.states
        before = int(hit_time / step)
        part = hit_time / step - before
        at_hit = states[before] + part * (states[before + 1] - states[before])
        ball = _ball(at_hit)
        touches = np.flatnonzero(record.touching)
        untouched = at_hit[BALL_POSITION].copy()
        if touches.size and touches[0] <= before:
            # The state that entered the first step with contact is still free of it.
            free = states[touches[0]]
            untouched = np.array(flight(_ball(free), hit_time - touches[0] * step, self._curl(free))[:3])
        return Play(
            hit_time=hit_time,
            ball=ball,
            untouched=untouched,
            paddle=self._arm.tool(at_hit[ARM_POSITION], at_hit[ARM_VELOCITY]),
            touched=bool(touches.size),
            end=step * (len(states) - 1),
            after=_ball(states[-1]),
            time=np.arange(len(states), dtype=np.float64) * step,
            joints=states[:, ARM_POSITION],
            path=states[:, BALL_POSITION],
            curl=self._curl(states[-1]),
        )

    def _curl(self, state: Array) -> Curl:
        if not self._magnus:
            return None
        return curl_of(rotated(state[None, BALL_ROTATION], state[None, BALL_SPIN])[0])


def _ball(state: Array) -> Ball:
    return Ball(*state[BALL_POSITION].tolist(), *state[BALL_VELOCITY].tolist())
