import pytest

from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.throw import Throw


@pytest.fixture(scope="package")
def contact() -> Throw:
    return Throw(SkillOptions())


@pytest.fixture(scope="package")
def analytic() -> Throw:
    return Throw(SkillOptions(environment="analytic"))
