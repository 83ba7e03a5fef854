from collections.abc import Callable

import pytest

from crkr.client.tally import Tally
from crkr.sim_worker.arm.dynamics import Arm
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.scene import make_arm, make_simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture(scope="package")
def arm() -> Arm:
    return make_arm()


@pytest.fixture(scope="package")
def simulation() -> Simulation:
    return make_simulation()


@pytest.fixture(scope="package")
def skill() -> TableTennis:
    return TableTennis(SkillOptions())


@pytest.fixture(scope="package")
def planned_returns() -> Callable[..., Tally]:
    """Plays the planner in the contexts of an evaluation."""

    def play(launcher: str, balls: int, seed: int, environment: str = "contact") -> Tally:
        player = TableTennis(SkillOptions(environment=environment, launcher=launcher), traces=False)
        tally = Tally()
        for ball in range(balls):
            tally.add(player.best_plan(player.reset(fresh_rng(seed, ball))))
        return tally

    return play
