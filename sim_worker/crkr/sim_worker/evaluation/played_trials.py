"""Trials that are played for a film, as in `crkr page`, and not stored."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, final

from crkr.protocol import Array, Geom, Invalid, StoredTrial, TaskSpec, Trace
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import SkillOptions, TrialResult
from crkr.sim_worker.skill_registry import load_skill, skill_of
from crkr.sim_worker.worker.telemetry import thinned

__all__ = ["PlayedTrial", "play_trials"]

PLAYED: Final = 24  # fresh contexts
MOST: Final = 72  # time to find one that fails
LONGEST_S: Final = 20.0


@final
@dataclass(frozen=True, slots=True)
class PlayedTrial:
    """One trial.

    Attributes:
        cost: In [0, 1], or None.
        success: Whether it succeeded.
        reason: How it ended, in the skill's words.
        trace: How things moved, or None.
        seq: Log position of a replayed trial; None for a new one.
    """

    cost: float | None
    success: bool
    reason: str
    trace: Trace | None
    seq: int | None = None


def play_trials(
    given: str | None,
    stored: TaskSpec,
    trials: Sequence[Sequence[StoredTrial]],
    goals: Callable[[Array], Array] | None,
) -> tuple[Sequence[Geom], list[PlayedTrial]]:
    """Play trials by a skill; returns its scene and the trials, empty without a known skill or a scene.

    A skill with `restore` replays the first trial with a motion of each group. Others play fresh contexts for at most
    20 s, until one fails.

    Args:
        given: The skill, as `crkr workers` takes it; None: the installed skill that the task names.
        stored: Of the task.
        trials: Stored trials, by groups.
        goals: The policy for fresh contexts.

    Raises:
        Invalid: There is no such skill, its task has states or goals of other sizes, or it lacks `restore` and there is
            no policy.
        SkillFault: The skill fails.
    """
    name = given or skill_of(stored)
    if name is None:
        return (), []
    skill = GuardedSkill(load_skill(name, SkillOptions(name=stored.name)))
    made = skill.spec()
    if (len(made.state), len(made.goal)) != (len(stored.state), len(stored.goal)):
        raise Invalid(
            f"skill {name!r} maps R^{len(made.state)} to R^{len(made.goal)}, and task {stored.name!r} "
            f"R^{len(stored.state)} to R^{len(stored.goal)}; name the skill that the task was made with"
        )
    scene = skill.scene()
    if not scene:
        return (), []
    if skill.can_restore and any(trials):
        return scene, list(_again(skill, trials))
    if goals is None:
        raise Invalid(f"skill {name!r} cannot put a stored state (a method `restore`), so no stored trial can be shown")
    return scene, list(_fresh(skill, goals))


def _again(skill: GuardedSkill, trials: Sequence[Sequence[StoredTrial]]) -> Iterator[PlayedTrial]:
    shown = set[int]()
    for group in trials:
        for one in group:
            if one.seq in shown:
                continue
            skill.restore(one.trial.state)
            result = skill.execute(one.trial.goal)
            if result.trace is not None:
                shown.add(one.seq)
                yield _played(result, one.seq)
                break


def _fresh(skill: GuardedSkill, goals: Callable[[Array], Array]) -> Iterator[PlayedTrial]:
    deadline, failed = time.monotonic() + LONGEST_S, False
    for context in range(MOST):
        state = skill.reset(fresh_rng(0, context))
        result = skill.execute(goals(state))
        yield _played(result)
        failed |= not result.success
        if (context + 1 >= PLAYED and failed) or time.monotonic() > deadline:
            return


def _played(result: TrialResult, seq: int | None = None) -> PlayedTrial:
    reason = str(result.info.get("reason") or ("success" if result.success else "no success"))
    trace = None if result.trace is None else thinned(result.trace)
    return PlayedTrial(result.cost, result.success, reason[:48], trace, seq)
