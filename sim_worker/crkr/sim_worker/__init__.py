"""Simulated robots that learn through the service: skills, the trial loop, and the processes that run it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from crkr.sim_worker.skill import Demonstration, Geom, Skill, SkillFactory, SkillOptions, Trace, TrialResult
from crkr.sim_worker.skill_registry import installed_skills, load_skill

__all__ = [
    "Demonstration",
    "Geom",
    "Skill",
    "SkillFactory",
    "SkillOptions",
    "Trace",
    "TrialResult",
    "installed_skills",
    "load_skill",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """The old name of `TrialResult`, for one release."""
        if name == "Outcome":
            warnings.warn("crkr.sim_worker.Outcome is now called TrialResult", DeprecationWarning, stacklevel=2)
            return TrialResult
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
