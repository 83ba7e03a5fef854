"""One whole run of learning in one process: demonstrations, training trials, judgement on fresh contexts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Final, Protocol, final
from uuid import UUID

import numpy as np

from crkr.client.evaluations import success_by_criterion
from crkr.learner import Learner
from crkr.protocol import training_id
from crkr.sim_worker.randomness import demonstration_rng, evaluation_rng, fresh_rng, training_rng
from crkr.sim_worker.skill import Skill

__all__ = ["Course", "LearningRun", "Score", "learn_once"]

WATCHED: Final = 100  # contexts behind each point of a learning curve
MARKS: Final = (0, 25, 50, 100, 200, 300, 500, 750, 1000, 1250)  # trials after which a curve has a point


@final
@dataclass(frozen=True, slots=True)
class Course:
    """What every run does.

    Attributes:
        trials: Training trials, refused goals included.
        contexts: Fresh contexts of the final judgement.
        judge: Seed of these contexts; the same for every run, and those of `crkr evaluate` with this seed.
        demonstrations: How many start the learner.
        watch: Whether to play for a learning curve on the way, which changes nothing else.
    """

    trials: int
    contexts: int
    judge: int
    demonstrations: int
    watch: bool


@final
@dataclass(frozen=True, slots=True)
class Score:
    """A policy without exploration, judged.

    Attributes:
        trials: Training trials that it had learned from.
        contexts: How many were played.
        successes: By criterion.
        reasons: How they ended, by the skill's words.
    """

    trials: int
    contexts: int
    successes: dict[str, int]
    reasons: dict[str, int]

    def rate(self, criterion: str) -> float:
        """Share of successes."""
        return self.successes[criterion] / self.contexts


@final
@dataclass(frozen=True, slots=True)
class LearningRun:
    """What one seed gave.

    Attributes:
        seed: Of demonstrations, contexts and exploration.
        final: The judgement after the last trial.
        curve: Scores on fewer contexts on the way, the last one after the last trial; empty if not watched.
        training: How the training trials ended, by the skill's words.
        digest: SHA-256 over every training trial's state, goal and cost: equal for runs that are bitwise the same.
    """

    seed: int
    final: Score
    curve: tuple[Score, ...]
    training: dict[str, int]
    digest: str


class Digest(Protocol):
    """What hashlib makes."""

    def update(self, data: bytes, /) -> None:
        """Takes in more bytes."""
        ...


def learn_once(skill: Skill, course: Course, seed: int) -> LearningRun:
    """Learns by the skill's own specification and judges the result; the same arguments give the same bits."""
    learner = Learner(replace(skill.spec(), seed=seed))
    for shown in skill.demonstrations(course.demonstrations, demonstration_rng(seed)):
        learner.report(
            state=shown.state, goal=shown.goal, cost=shown.result.cost, success=True, kind="demonstration",
            outcome=shown.result.outcome,
        )  # fmt: skip
    rng, training, curve = training_rng(seed, 1), Counter[str](), []
    digest = sha256()
    for trial in range(course.trials):
        if course.watch and trial in MARKS:
            curve.append(_judge(skill, learner, trial, WATCHED, lambda ball: evaluation_rng(seed, ball)))
        trial_id = training_id(
            learner.spec.name, seed, 1, trial + 1
        )  # as a worker's: what is asked between is no matter
        training[_try(skill, learner, rng, trial_id, digest)] += 1
    if course.watch:
        curve.append(_judge(skill, learner, course.trials, WATCHED, lambda ball: evaluation_rng(seed, ball)))
    final = _judge(skill, learner, course.trials, course.contexts, lambda ball: fresh_rng(course.judge, ball))
    return LearningRun(seed, final, tuple(curve), dict(training.most_common()), digest.hexdigest())


def _try(skill: Skill, learner: Learner, rng: np.random.Generator, trial_id: UUID, digest: Digest) -> str:
    """One training trial; how it ended."""
    answer = learner.predict(skill.reset(rng), explore=True, trial_ids=trial_id)
    result = skill.execute(answer.goals)
    kind = "trial" if result.executed else "failed"
    success = result.success and result.executed
    digest.update(np.array([*answer.states, *answer.goals, np.nan if result.cost is None else result.cost]).tobytes())
    learner.report(answer, cost=result.cost, success=success, kind=kind, outcome=result.outcome)
    return str(result.info.get("reason", "success" if success else "failure"))


def _judge(
    skill: Skill, learner: Learner, trials: int, contexts: int, rng: Callable[[int], np.random.Generator]
) -> Score:
    goals = learner.predict(np.array([skill.reset(rng(ball)) for ball in range(contexts)])).goals
    successes, reasons = Counter[str](), Counter[str]()
    for ball, goal in enumerate(goals):
        skill.reset(rng(ball))
        result = skill.execute(goal)
        successes.update({name: int(won) for name, won in success_by_criterion(result.success, result.info).items()})
        reasons[str(result.info.get("reason", "success" if result.success else "failure"))] += 1
    return Score(trials, contexts, dict(successes), dict(reasons.most_common()))
