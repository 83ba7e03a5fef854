"""Judges a task's policy on many fresh contexts: one question to the server, then execution in several processes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.client import Task
from crkr.client.tally import Tally, success_by_criterion
from crkr.protocol import MAX_STATES, Invalid, Prediction, Trial, task_id
from crkr.sim_worker.evaluation.contexts import COST_OF_NOTHING
from crkr.sim_worker.evaluation.oracle import Planner
from crkr.sim_worker.guarded_skill import GuardedSkill, guarded_plan
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import Floats, Outcome, Skill, SkillOptions
from crkr.sim_worker.supervisor.pool import spread

__all__ = ["Assessment", "Played", "ask", "play", "record"]

CHUNK: Final = 10
STORED_AT_ONCE: Final = 500


@final
@dataclass(frozen=True, slots=True)
class Played:
    """One context, played.

    Attributes:
        ball: Which.
        result: What the policy's goal gave, without a trace.
        oracle: Success of the skill's own planner by criterion; None where it has none or was not asked.
    """

    ball: int
    result: Outcome
    oracle: dict[str, bool] | None


@final
@dataclass(slots=True)
class Assessment:
    """Counts over the contexts played.

    Attributes:
        policy: What was played.
        reasons: How trials ended, by the skill's words.
        oracle: The planner's plans for the same contexts; empty where there is no planner.
    """

    policy: Tally = field(default_factory=Tally)
    reasons: Counter[str] = field(default_factory=Counter)
    oracle: Tally = field(default_factory=Tally)

    def add(self, played: Played) -> None:
        """Counts one context."""
        self.policy.add(success_by_criterion(played.result.success, played.result.info))
        self.reasons[str(played.result.info.get("reason", "success" if played.result.success else "failure"))] += 1
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


def ask(task: Task, skill: Skill, balls: int, seed: int) -> list[Prediction]:
    """The policy's goals for `balls` fresh contexts, in messages of at most 4096.

    Raises:
        Invalid: The skill has other states or goals than the task.
    """
    mine, theirs = skill.spec(), task.spec
    if (len(mine.state), len(mine.goal)) != (len(theirs.state), len(theirs.goal)):
        raise Invalid(
            f"the skill maps R^{len(mine.state)} to R^{len(mine.goal)}, but task {task.name!r} maps "
            f"R^{len(theirs.state)} to R^{len(theirs.goal)}; name its skill with --skill"
        )
    states = np.array([skill.reset(fresh_rng(seed, ball)) for ball in range(balls)])
    return [task.predict(states[start : start + MAX_STATES]) for start in range(0, balls, MAX_STATES)]


def play(
    skill: str,
    options: SkillOptions,
    goals: Floats,
    seed: int,
    *,
    jobs: int,
    oracle: bool,
    show: Callable[[int], None],
) -> list[Played]:
    """Executes goals (b, p) in the contexts that `ask` asked about, `jobs` at a time; in order of the contexts.

    Raises:
        CrkrError: A process was lost.
    """
    starts = range(0, len(goals), CHUNK)
    parts = [_Part(start, goals[start : start + CHUNK], seed, oracle) for start in starts]
    played: dict[int, Played] = {}
    for results in spread(skill, options, _play_part, parts, jobs):
        played.update({one.ball: one for one in results})
        show(len(played))
    return [played[ball] for ball in range(len(goals))]


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Goals (n, p) for the contexts from `start` on."""

    start: int
    goals: Floats
    seed: int
    oracle: bool


def _play_part(skill: Skill, part: _Part) -> list[Played]:
    planner = skill if part.oracle and isinstance(skill, Planner) else None
    player = GuardedSkill(skill)
    played = []
    for ball, goal in enumerate(part.goals, part.start):
        state = player.reset(fresh_rng(part.seed, ball))
        result = player.execute(goal)
        best = None if planner is None else guarded_plan(planner, state)
        bare = Outcome(result.cost, result.success, result.executed, result.outcome, dict(result.info), None)
        played.append(Played(ball, bare, best))
    return played


def record(task: Task, answers: list[Prediction], played: list[Played], seed: int, source: str) -> int:
    """Stores the contexts played as evaluations; returns how many were new.

    The same goal in the same context of the same environment is one trial, whenever the policy is asked.

    Args:
        task: Where.
        answers: The policy's answers.
        played: What they gave, in order.
        seed: Of the contexts.
        source: Environment and launcher in force, as part of the ids.
    """
    rows = [
        (answer.states[row], answer.goals[row], answer.model_version) for answer in answers for row in _rows(answer)
    ]
    trials = [
        _identified(
            task,
            f"evaluate/{source}/{seed}/{one.ball}",
            state=state,
            goal=goal,
            cost=COST_OF_NOTHING if one.result.cost is None else one.result.cost,
            success=one.result.success,
            kind="evaluation",
            outcome=one.result.outcome,
            worker="evaluate",
            model_version=version,
            info={**one.result.info, "ball": one.ball, "seed": seed, "source": source},
        )
        for one, (state, goal, version) in zip(played, rows, strict=True)
    ]
    starts = range(0, len(trials), STORED_AT_ONCE)
    return sum(task.report_trials(trials[start : start + STORED_AT_ONCE]).accepted for start in starts)


def _identified(task: Task, context: str, **content: Any) -> Trial:
    """A trial whose id follows from its context and its content."""
    trial = Trial.create(task.spec, id=UUID(int=0), **content)
    return replace(trial, id=task_id(task.name, f"{context}/{trial.digest().hex()}"))


def _rows(answer: Prediction) -> range:
    return range(len(answer.goals))
