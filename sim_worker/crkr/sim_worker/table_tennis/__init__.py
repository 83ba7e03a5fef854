"""Table tennis with a six-joint arm, the skill that crkr ships: R^6 -> R^13."""

from __future__ import annotations

from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["TableTennis", "make", "make_cautious", "make_lifted", "make_profiled"]


def make(options: SkillOptions) -> Skill:
    """Makes the skill; raises `crkr.protocol.Invalid` for an option it does not know."""
    return TableTennis(options)


def make_profiled(options: SkillOptions) -> Skill:
    """The skill with swings that follow a recorded demonstration; name it as package.module:factory."""
    return TableTennis(options, profiled=True)


def make_cautious(options: SkillOptions) -> Skill:
    """The skill that refuses swings in which the arm would touch itself; name it as package.module:factory."""
    return TableTennis(options, cautious=True)


def make_lifted(options: SkillOptions) -> Skill:
    """The skill with a ball that its spin lifts; name it as package.module:factory."""
    return TableTennis(options, magnus=True)
