"""What trials cost in each environment, beside what they cannot do without, in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from crkr.sim_worker.primitives.stroke import JointLimits, Primitive
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.arm import tracking
from crkr.sim_worker.table_tennis.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS, Arm
from crkr.sim_worker.table_tennis.environments.analytic_batch import AnalyticBatch
from crkr.sim_worker.table_tennis.environments.environments import ENVIRONMENTS
from crkr.sim_worker.table_tennis.environments.play import FOLLOW
from crkr.sim_worker.table_tennis.environments.simulation import Simulation
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["EnvironmentBench", "bench_environments"]

Floats = NDArray[np.float64]


@final
@dataclass(frozen=True, slots=True)
class EnvironmentBench:
    """Mean processor times of the same trials, learning not included.

    Attributes:
        trials: How many were timed in each environment.
        contact_ms: Whole trial in contact [ms].
        bare_ms: The simulator's steps alone of those trials [ms].
        hybrid_ms: Whole trial with an exact ball [ms].
        analytic_ms: Whole trial by formulas, one by one [ms].
        batch: How many trials were played at once.
        batch_us: One of them [microseconds].
    """

    trials: int
    contact_ms: float
    bare_ms: float
    hybrid_ms: float
    analytic_ms: float
    batch: int
    batch_us: float

    @property
    def contact_over_bare(self) -> float:
        """Whole contact trial over its bare steps."""
        return self.contact_ms / self.bare_ms

    @property
    def hybrid_over_contact(self) -> float:
        """Hybrid trial over contact trial."""
        return self.hybrid_ms / self.contact_ms

    @property
    def batch_speedup(self) -> float:
        """Batched analytic trials a second over scalar ones."""
        return 1000 * self.analytic_ms / self.batch_us


def bench_environments(balls: Floats, goals: Floats, batch: int = 3000) -> EnvironmentBench:
    """Times the same trials in every environment, alternating between them.

    Args:
        balls: (n, 6) as measured.
        goals: (n, 13) for them, e.g. as a learner chose them; all are executed in contact.
        batch: Size of the batch, which repeats them.
    """
    skills = {name: TableTennis(SkillOptions(environment=name), traces=False) for name in ENVIRONMENTS}
    spent = dict.fromkeys([*ENVIRONMENTS, "bare"], 0.0)
    bare = _Bare()
    for skill in skills.values():
        skill.attempt(balls[0], goals[0])  # so that everything is warm
    for ball, goal in zip(balls, goals, strict=True):
        for name, skill in skills.items():
            spent[name] += _timed(lambda skill=skill, ball=ball, goal=goal: skill.attempt(ball, goal))  # type: ignore[misc]  # bound now
        spent["bare"] += bare.timed(ball, goal)
    rows = np.resize(np.arange(len(balls)), batch)
    many = AnalyticBatch(Arm())
    many.play(balls[rows], goals[rows])
    at_once = _timed(lambda: many.play(balls[rows], goals[rows]))
    mean = {name: 1e3 * total / len(balls) for name, total in spent.items()}
    return EnvironmentBench(
        len(balls), mean["contact"], mean["bare"], mean["hybrid"], mean["analytic"], batch, 1e6 * at_once / batch
    )


class _Bare:
    """The contact simulation of a goal with everything else prepared."""

    def __init__(self) -> None:
        self._arm, self._simulation = Arm(), Simulation()
        self._primitive = Primitive(JointLimits(self._arm.lower, self._arm.upper, SPEED_LIMITS, ACCELERATION_LIMITS))

    def timed(self, ball: Floats, goal: Floats) -> float:
        hit_time = float(goal[12])
        swing = self._primitive.trajectory(HOME, goal[:6], goal[6:12], hit_time)
        step = self._simulation.timestep
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / step)), dtype=np.float64) * step
        controls = tracking.controls(self._arm, self._simulation.gains, swing, times)
        start = self._simulation.start(HOME, ball)
        return _timed(lambda: self._simulation.run(start, controls))


def _timed(call: Callable[[], object]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin
