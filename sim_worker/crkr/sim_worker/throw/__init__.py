"""A six-joint arm throws a ball over a wall into a bin: R^4 -> R^8. It needs no demonstration."""

from __future__ import annotations

from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.throw.throw import Throw

__all__ = ["Throw", "make"]


def make(options: SkillOptions) -> Skill:
    """Makes the skill; raises `crkr.protocol.Invalid` for an option it does not know."""
    return Throw(options)
