"""Trials that are played to be looked at, as in the film of `crkr page`; nothing of them is stored."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, final

from crkr.client import Task
from crkr.protocol import Geom, Invalid, Trace
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.skill_registry import load_skill, skill_of

__all__ = ["PlayedTrial", "play_trials"]

MOST: Final = 3  # times as many contexts, to find one that fails
LONGEST_S: Final = 20.0


@final
@dataclass(frozen=True, slots=True)
class PlayedTrial:
    """One trial of the task's policy, without exploration.

    Attributes:
        cost: In [0, 1], or None.
        success: Whether it did what was wanted.
        reason: How it ended, in the skill's words.
        trace: How things moved, or None.
    """

    cost: float | None
    success: bool
    reason: str
    trace: Trace | None


def play_trials(given: str | None, task: Task, count: int) -> tuple[Sequence[Geom], list[PlayedTrial]]:
    """Play fresh contexts by a skill, and return its scene and the trials; nothing where no skill is known.

    It plays `count` contexts, and up to three times as many while none fails, for at most 20 s.

    Args:
        given: The skill, as `crkr workers` takes it; None is the installed one that the task says it is for.
        task: Whose policy is asked.
        count: Of contexts.

    Raises:
        Invalid: There is no such skill, or its task has states or goals of other sizes.
        SkillFault: The skill fails.
    """
    name = given or skill_of(task.spec)
    if name is None:
        return (), []
    skill = GuardedSkill(load_skill(name, SkillOptions(name=task.name)))
    made, stored = skill.spec(), task.spec
    if (len(made.state), len(made.goal)) != (len(stored.state), len(stored.goal)):
        raise Invalid(
            f"skill {name!r} maps R^{len(made.state)} to R^{len(made.goal)}, and task {task.name!r} "
            f"R^{len(stored.state)} to R^{len(stored.goal)}; name the skill that the task was made with"
        )
    scene, played = skill.scene(), []
    deadline = time.monotonic() + LONGEST_S
    for context in range(MOST * count):
        state = skill.reset(fresh_rng(0, context))
        result = skill.execute(task.predict(state).goal)
        reason = str(result.info.get("reason") or ("success" if result.success else "no success"))
        played.append(PlayedTrial(result.cost, result.success, reason[:48], result.trace))
        enough = len(played) >= count and not all(one.success for one in played)
        if enough or time.monotonic() > deadline:
            break
    return scene, played
