"""The skill's own planner as a player, where a skill has one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Protocol, runtime_checkable

from crkr.client.tally import Tally
from crkr.protocol import Invalid
from crkr.sim_worker.guarded_skill import GuardedSkill, guarded_plan
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import Floats, Skill, SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.pool import spread

__all__ = ["Planner", "play_oracle"]

CHUNK: Final = 10


@runtime_checkable
class Planner(Protocol):
    """What a skill may offer beside `Skill`: plans from a model of the task rather than from what was learned."""

    def best_plan(self, ball: Floats, /) -> Mapping[str, bool]:
        """Whether one of its plans for a state (d,) succeeds, by each criterion."""
        ...


def play_oracle(
    skill: str, options: SkillOptions, balls: int, seed: int, *, jobs: int, show: Callable[[int], None]
) -> Tally:
    """Plans for the contexts that an evaluation with this seed plays, and tallies successes.

    Raises:
        Invalid: The skill has no planner.
        CrkrError: A process was lost.
    """
    if not isinstance(load_skill(skill, options), Planner):
        raise Invalid(f"skill {skill!r} has no planner of its own (a method `best_plan`)")
    parts = [(seed, range(start, min(start + CHUNK, balls))) for start in range(0, balls, CHUNK)]
    won = Tally()
    for part in spread(skill, options, _plan, parts, jobs):
        for outcomes in part:
            won.add(outcomes)
        show(won.trials)
    return won


def _plan(skill: Skill, part: tuple[int, range]) -> list[dict[str, bool]]:
    if not isinstance(skill, Planner):
        raise Invalid("the skill has no planner of its own")
    seed, balls = part
    player = GuardedSkill(skill)
    return [guarded_plan(skill, player.reset(fresh_rng(seed, ball))) for ball in balls]
