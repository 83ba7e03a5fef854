"""The environments by name: how swings are executed, and what predicts a ball there."""

from __future__ import annotations

from typing import Final

from crkr.sim_worker.table_tennis.arm.dynamics import Arm
from crkr.sim_worker.table_tennis.ball.incoming import FreeBall
from crkr.sim_worker.table_tennis.environments.analytic import AnalyticEnvironment
from crkr.sim_worker.table_tennis.environments.contact import ContactEnvironment
from crkr.sim_worker.table_tennis.environments.hybrid import HybridEnvironment
from crkr.sim_worker.table_tennis.environments.partial_scenes import ArmAlone, BallAlone
from crkr.sim_worker.table_tennis.environments.play import Environment
from crkr.sim_worker.table_tennis.environments.simulation import Simulation
from crkr.sim_worker.table_tennis.planner import Predictor

__all__ = ["ENVIRONMENTS", "make_environment", "make_predictor"]

ENVIRONMENTS: Final = ("contact", "hybrid", "analytic")


def make_environment(name: str, arm: Arm, simulation: Simulation) -> Environment:
    """The environment of that name, one of `ENVIRONMENTS`, with lift where `simulation` has it."""
    if name == "contact":
        return ContactEnvironment(arm, simulation)
    if name == "hybrid":
        return HybridEnvironment(arm, ArmAlone(), magnus=simulation.magnus)
    return AnalyticEnvironment(arm, magnus=simulation.magnus)


def make_predictor(name: str, *, magnus: bool = False) -> Predictor:
    """What a ball does that nobody hits, in the environment of that name."""
    return BallAlone(magnus=magnus) if name == "contact" else FreeBall(magnus=magnus)
