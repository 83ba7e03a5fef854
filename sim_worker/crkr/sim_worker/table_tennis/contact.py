"""Everything by contact simulation: arm, ball, table and paddle in MuJoCo."""

from __future__ import annotations

from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.table_tennis.arm import Arm
from crkr.sim_worker.table_tennis.ball import Ball, flight
from crkr.sim_worker.table_tennis.joint_trajectory import JointTrajectory
from crkr.sim_worker.table_tennis.play import Play
from crkr.sim_worker.table_tennis.simulation import (
    ARM_POSITION,
    ARM_VELOCITY,
    BALL_POSITION,
    BALL_VELOCITY,
    Recording,
    Simulation,
)

__all__ = ["ContactEnvironment"]

Floats = NDArray[np.float64]

FOLLOW = 0.12  # what is simulated after the hit time [s]; from then on the ball only flies
PARTING = 0.02  # added while ball and paddle are still in contact [s]
MOST_PARTINGS = 5


@final
class ContactEnvironment:
    """Executes swings in the contact simulation; the same ball and swing give the same bits."""

    def __init__(self, arm: Arm, simulation: Simulation) -> None:
        self._arm = arm
        self._simulation = simulation

    def play(self, ball: Floats, swing: JointTrajectory, hit_time: float) -> Play:
        """Executes `swing` against the ball measured as `ball` (6,) at time 0.

        Raises:
            Diverged: The simulator broke down.
        """
        step = self._simulation.timestep
        steps = int(np.ceil((hit_time + FOLLOW) / step))
        extra = int(PARTING / step)
        controls = self.controls(swing, np.arange(steps + MOST_PARTINGS * extra, dtype=np.float64) * step)
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

    def controls(self, swing: JointTrajectory, times: Floats) -> Floats:
        """Actuator controls (n, 6) that track the swing: feedback around it, and its inverse dynamics fed forward."""
        position, velocity, _ = swing.sample(times)
        simulation = self._simulation
        return simulation.stiffness * position + simulation.damping * velocity + self._feed_forward(swing, times)

    def _feed_forward(self, swing: JointTrajectory, times: Floats) -> Floats:
        """Inverse dynamics (n, 6), exact at both ends of each interval of constant acceleration and linear within."""
        last = len(swing.time) - 1
        torques = self._arm.torques
        begin, end = np.empty((last, 6)), np.empty((last, 6))
        for knot, acceleration in enumerate(swing.acceleration):
            begin[knot] = torques(swing.position[knot], swing.velocity[knot], acceleration)
            end[knot] = torques(swing.position[knot + 1], swing.velocity[knot + 1], acceleration)
        still = np.zeros(6)
        rest = torques(swing.position[-1], still, still)
        at = np.minimum(np.searchsorted(swing.time, times, side="right") - 1, last - 1)
        part = ((times - swing.time[at]) / (swing.time[at + 1] - swing.time[at]))[:, None]
        moving = (times < swing.time[-1])[:, None]
        return np.where(moving, begin[at] + part * (end[at] - begin[at]), rest)

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
            untouched = np.array(flight(_ball(states[touches[0]]), hit_time - touches[0] * step)[:3])
        return Play(
            hit_time=hit_time,
            ball=ball,
            untouched=untouched,
            paddle=self._arm.paddle(at_hit[ARM_POSITION], at_hit[ARM_VELOCITY]),
            touched=bool(touches.size),
            end=step * (len(states) - 1),
            after=_ball(states[-1]),
            time=np.arange(len(states), dtype=np.float64) * step,
            joints=states[:, ARM_POSITION],
            path=states[:, BALL_POSITION],
        )


def _ball(state: Floats) -> Ball:
    return Ball(*state[BALL_POSITION].tolist(), *state[BALL_VELOCITY].tolist())
