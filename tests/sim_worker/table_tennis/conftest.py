import pytest

from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.arm import Arm
from crkr.sim_worker.table_tennis.simulation import Simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture(scope="package")
def arm() -> Arm:
    return Arm()


@pytest.fixture(scope="package")
def simulation() -> Simulation:
    return Simulation()


@pytest.fixture(scope="package")
def skill() -> TableTennis:
    return TableTennis(SkillOptions())
