"""Gymnasium's environments as skills: a trial is an episode with a motion planned at its start."""

from __future__ import annotations

from crkr.sim_worker.gymnasium.skill import GymnasiumSkill, gymnasium_skill

__all__ = ["GymnasiumSkill", "gymnasium_skill"]
