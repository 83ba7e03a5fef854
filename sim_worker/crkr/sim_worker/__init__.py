"""Simulated robots that learn through the service: skills, the trial loop, and the processes that run it."""

from __future__ import annotations

from crkr.sim_worker.skill import Demonstration, Geom, Outcome, Skill, SkillFactory, SkillOptions, Trace
from crkr.sim_worker.skill_registry import installed_skills, load_skill

__all__ = [
    "Demonstration",
    "Geom",
    "Outcome",
    "Skill",
    "SkillFactory",
    "SkillOptions",
    "Trace",
    "installed_skills",
    "load_skill",
]
