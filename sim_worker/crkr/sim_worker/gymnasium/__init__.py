"""Gymnasium's environments as skills: one trial is one episode, whose motion is decided at its start."""

from __future__ import annotations

from crkr.sim_worker.gymnasium.skill import GymnasiumSkill, gymnasium_skill

__all__ = ["GymnasiumSkill", "gymnasium_skill"]
