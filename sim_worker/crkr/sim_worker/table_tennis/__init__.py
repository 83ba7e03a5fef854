"""Table tennis with a six-joint arm, the skill that crkr ships: R^6 -> R^13."""

from __future__ import annotations

from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["TableTennis", "make"]


def make(options: SkillOptions) -> Skill:
    """Makes the skill; raises `crkr.protocol.Invalid` for an option it does not know."""
    return TableTennis(options)
