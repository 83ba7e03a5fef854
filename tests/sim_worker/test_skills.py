"""Finding skills."""

import pytest

from crkr.protocol import Invalid
from crkr.sim_worker import SkillOptions, installed_skills, load_skill

pytestmark = pytest.mark.usefixtures("skills_here")


def test_the_shipped_skill_is_installed() -> None:
    assert "table-tennis" in installed_skills()


def test_a_skill_of_ones_own_is_found_by_module_and_factory() -> None:
    assert load_skill("reaching:make", SkillOptions(name="mine")).spec().name == "mine"


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("tabel-tennis", "installed: .*table-tennis"),
        ("no_such_module:make", "no module 'no_such_module'"),
        ("reaching:build", "no factory 'build'"),
        ("reaching:REACH", "no factory 'REACH'"),
    ],
)
def test_a_skill_that_is_not_there_is_refused_with_what_is(name: str, complaint: str) -> None:
    with pytest.raises(Invalid, match=complaint):
        load_skill(name, SkillOptions())


def test_a_library_that_a_skill_lacks_is_not_mistaken_for_the_skill() -> None:
    with pytest.raises(ModuleNotFoundError, match="no_such_library"):
        load_skill("lacking:make", SkillOptions())
