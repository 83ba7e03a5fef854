"""The analytic planner as a player: the reference for what is possible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from crkr.protocol import Invalid
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["OracleRates", "oracle"]


@final
@dataclass(frozen=True, slots=True)
class OracleRates:
    """How often the planner returns a ball.

    Attributes:
        balls: How many were played.
        paper: Rate by the paper's criterion.
        strict: Rate by the strict criterion.
    """

    balls: int
    paper: float
    strict: float


def oracle(launcher: str, balls: int, seed: int, environment: str = "contact") -> OracleRates:
    """Plays the balls that an evaluation with the same seed plays; one of at most ten plans a ball must return it.

    The plans aim at the strict criterion and are tried in simulation, best first: what fails has no planned return
    within the joint limits and clear of the table. It is a reference, not a bound.

    Args:
        launcher: "nominal", "medium" or "wide".
        balls: How many to play, at least one.
        seed: Of the evaluation.
        environment: Where the plans are tried.

    Raises:
        Invalid: An option of another name, or no balls.
    """
    if balls < 1:
        raise Invalid(f"an oracle needs at least one ball; got {balls}")
    skill = TableTennis(SkillOptions(environment=environment, launcher=launcher), traces=False)
    won = {"paper": 0, "strict": 0}
    for ball in range(balls):
        outcomes = skill.best_plan(skill.reset(fresh_rng(seed, ball)))
        for criterion in won:
            won[criterion] += outcomes[criterion]
    return OracleRates(balls, won["paper"] / balls, won["strict"] / balls)
