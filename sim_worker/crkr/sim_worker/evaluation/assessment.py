"""A policy, or a skill's own planner, on many fresh contexts, executed in several processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.client import Task
from crkr.client.tally import Tally, success_by_criterion
from crkr.protocol import MAX_STATES, Array, Invalid, Prediction, Trial, task_id
from crkr.sim_worker.evaluation.contexts import COST_OF_NOTHING
from crkr.sim_worker.guarded_skill import GuardedSkill, guarded_plan
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import HasPlanner, Skill, SkillOptions, TrialResult, judged_state
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.pool import spread

__all__ = ["Assessment", "PlayedContext", "ask", "play", "play_oracle", "record"]

CHUNK: Final = 10
STORED_AT_ONCE: Final = 500


@final
@dataclass(frozen=True, slots=True)
class PlayedContext:
    """One context, played.

    Attributes:
        context: Its number.
        result: Of the policy's goal, without a trace.
        oracle: Success of the skill's planner by criterion; None without a planner or where it was not asked.
    """

    context: int
    result: TrialResult
    oracle: dict[str, bool] | None


@final
@dataclass(slots=True)
class Assessment:
    """Counts over the contexts played.

    Attributes:
        policy: Success of the policy.
        reasons: How trials ended, in the skill's words.
        oracle: Success of the planner in the same contexts; empty without a planner.
    """

    policy: Tally = field(default_factory=Tally)
    reasons: Counter[str] = field(default_factory=Counter)
    oracle: Tally = field(default_factory=Tally)

    def add(self, played: PlayedContext) -> None:
        """Counts one context."""
        self.policy.add(success_by_criterion(played.result.success, played.result.info))
        self.reasons[played.result.reason] += 1
        if played.oracle:
            self.oracle.add(played.oracle)

    def to_dict(self) -> dict[str, Any]:
        """Rates, their 95 % intervals, reasons, and the planner's rates."""
        return {
            **self.policy.rates(),
            "ci95": self.policy.intervals(),
            "reasons": dict(self.reasons.most_common()),
            "oracle": self.oracle.rates() or None,
        }


def ask(task: Task, skill: Skill, contexts: int, seed: int) -> list[Prediction]:
    """The policy's goals for fresh contexts, in messages of at most 4096.

    Raises:
        Invalid: The skill has other states or goals than the task.
    """
    mine, theirs = skill.spec(), task.spec
    if (len(mine.state), len(mine.goal)) != (len(theirs.state), len(theirs.goal)):
        raise Invalid(
            f"the skill maps R^{len(mine.state)} to R^{len(mine.goal)}, but task {task.name!r} maps "
            f"R^{len(theirs.state)} to R^{len(theirs.goal)}; name its skill with --skill"
        )
    states = np.array([judged_state(skill, context, fresh_rng(seed, context)) for context in range(contexts)])
    return [task.predict(states[start : start + MAX_STATES]) for start in range(0, contexts, MAX_STATES)]


def play(
    skill: str,
    options: SkillOptions,
    goals: Array,
    seed: int,
    *,
    jobs: int,
    oracle: bool,
    show: Callable[[int], None],
) -> list[PlayedContext]:
    """Executes goals (b, p) in the contexts of `ask`, `jobs` at a time; results are in the order of the contexts.

    Raises:
        CrkrError: A process was lost.
    """
    starts = range(0, len(goals), CHUNK)
    parts = [_Part(start, goals[start : start + CHUNK], seed, oracle) for start in starts]
    played: dict[int, PlayedContext] = {}
    for results in spread(skill, options, _play_part, parts, jobs):
        played.update({one.context: one for one in results})
        show(len(played))
    return [played[context] for context in range(len(goals))]


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Goals (n, p) for the contexts from `start` on."""

    start: int
    goals: Array
    seed: int
    oracle: bool


def _play_part(skill: Skill, part: _Part) -> list[PlayedContext]:
    planner = skill if part.oracle and isinstance(skill, HasPlanner) else None
    player = GuardedSkill(skill)
    played = []
    for context, goal in enumerate(part.goals, part.start):
        state = judged_state(player, context, fresh_rng(part.seed, context))
        result = player.execute(goal)
        best = None if planner is None else guarded_plan(planner, state)
        bare = replace(result, info=dict(result.info), trace=None)
        played.append(PlayedContext(context, bare, best))
    return played


def record(task: Task, answers: list[Prediction], played: list[PlayedContext], seed: int, source: str) -> int:
    """Stores the contexts played as evaluations; returns how many were new.

    The same goal in the same context of the same environment is one trial, however often it is recorded.

    Args:
        task: Task that was judged.
        answers: The policy's answers.
        played: Their results, in order.
        seed: Of the contexts.
        source: Environment and launcher in force, as part of the ids.
    """
    rows = [
        (state, goal, answer.model_version)
        for answer in answers
        for state, goal in zip(answer.states, answer.goals, strict=True)
    ]
    trials = [
        _identified(
            task,
            f"evaluate/{source}/{seed}/{one.context}",
            state=state,
            goal=goal,
            cost=COST_OF_NOTHING if one.result.cost is None else one.result.cost,
            success=one.result.success,
            kind="evaluation",
            outcome=one.result.outcome,
            worker="evaluate",
            model_version=version,
            info={**one.result.info, "ball": one.context, "seed": seed, "source": source},
        )
        for one, (state, goal, version) in zip(played, rows, strict=True)
    ]
    starts = range(0, len(trials), STORED_AT_ONCE)
    return sum(task.report_trials(trials[start : start + STORED_AT_ONCE]).accepted for start in starts)


def _identified(task: Task, context: str, **content: Any) -> Trial:
    """A trial with an id derived from its context and content."""
    trial = Trial.create(task.spec, id=UUID(int=0), **content)
    return replace(trial, id=task_id(task.name, f"{context}/{trial.digest().hex()}"))


def play_oracle(
    skill: str, options: SkillOptions, contexts: int, seed: int, *, jobs: int, show: Callable[[int], None]
) -> Tally:
    """Success of the skill's planner in the contexts of an evaluation with this seed.

    Raises:
        Invalid: The skill has no planner.
        CrkrError: A process was lost.
    """
    if not isinstance(load_skill(skill, options), HasPlanner):
        raise Invalid(f"skill {skill!r} has no planner of its own (a method `best_plan`)")
    parts = [(seed, range(start, min(start + CHUNK, contexts))) for start in range(0, contexts, CHUNK)]
    won = Tally()
    for part in spread(skill, options, _plan, parts, jobs):
        for outcomes in part:
            won.add(outcomes)
        show(won.trials)
    return won


def _plan(skill: Skill, part: tuple[int, range]) -> list[dict[str, bool]]:
    if not isinstance(skill, HasPlanner):
        raise Invalid("the skill has no planner of its own")
    seed, contexts = part
    player = GuardedSkill(skill)
    return [guarded_plan(skill, judged_state(player, context, fresh_rng(seed, context))) for context in contexts]
