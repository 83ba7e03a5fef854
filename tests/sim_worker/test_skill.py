"""The names that a user's skill imports."""

from importlib import import_module

import pytest

from crkr.sim_worker import skill
from crkr.sim_worker.skill import TrialResult


@pytest.mark.parametrize("module", ["crkr.sim_worker", "crkr.sim_worker.skill"])
def test_the_old_name_of_a_trials_result_is_the_same_class_and_says_the_new_name(module: str) -> None:
    with pytest.warns(DeprecationWarning, match=rf"{module}\.Outcome is now called TrialResult"):
        assert import_module(module).Outcome is TrialResult
    with pytest.raises(AttributeError, match="no attribute 'Nothing'"):
        _ = import_module(module).Nothing


def test_one_module_has_every_name_that_a_skill_needs() -> None:
    needed = {"Demonstration", "Floats", "Geom", "Invalid", "SkillOptions", "TaskSpec", "Trace", "TrialResult"}
    assert needed <= set(skill.__all__)
    assert all(hasattr(skill, name) for name in skill.__all__)
