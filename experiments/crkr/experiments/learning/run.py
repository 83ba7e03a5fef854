"""One whole run of learning in one process: demonstrations, training trials, judgement on fresh contexts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields
from hashlib import sha256
from typing import Any, Final, Protocol, final
from uuid import UUID

import numpy as np

from crkr.client.tally import Tally, success_by_criterion
from crkr.learner import Learner
from crkr.protocol import TaskSpec, training_id
from crkr.sim_worker.randomness import demonstration_rng, evaluation_rng, fresh_rng, training_rng
from crkr.sim_worker.skill import Skill, SkillWithDemonstrations

__all__ = ["MARKS", "Course", "LearningRun", "Score", "learn_once", "taught"]

MARKS: Final = (0, 25, 50, 100, 200, 300, 500, 750, 1000, 1250)  # much is learned early


@final
@dataclass(frozen=True, slots=True)
class Course:
    """What every run does.

    Attributes:
        trials: Training trials, refused goals included.
        contexts: Fresh contexts of the final judgement.
        judge: Seed of these contexts; the same for every run, and those of `crkr evaluate` with this seed.
        demonstrations: How many start the learner.
        marks: Training trials after which a learning curve has a point, besides the last one; empty: there is no curve.
            Watching changes nothing else.
        watched: Contexts behind each of its points, the task's fixed ones.
        settings: Fields of the skill's specification that are others here.
    """

    trials: int
    contexts: int
    judge: int
    demonstrations: int
    marks: tuple[int, ...] = ()
    watched: int = 100
    settings: tuple[tuple[str, Any], ...] = ()


@final
@dataclass(frozen=True, slots=True)
class Score:
    """A policy without exploration, judged.

    Attributes:
        trials: Training trials that it had learned from.
        tally: The contexts that were played.
        reasons: How they ended, by the skill's words.
    """

    trials: int
    tally: Tally
    reasons: dict[str, int]

    @property
    def contexts(self) -> int:
        """How many were played."""
        return self.tally.trials

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        counts = {"judged": dict(self.tally.judged), "successes": dict(self.tally.successes)}
        return {"trials": self.trials, "contexts": self.contexts, **counts, "reasons": self.reasons}


@final
@dataclass(frozen=True, slots=True)
class LearningRun:
    """What one seed gave.

    Attributes:
        seed: Of demonstrations, contexts and exploration.
        final: The judgement after the last trial.
        curve: Scores on fewer contexts on the way, the last one after the last trial; empty if not watched.
        training: How the training trials ended, by the skill's words.
        filled: Training trials after which there were more samples to learn from than the budget; None: never.
        digest: SHA-256 over every training trial's state, goal and cost: equal for runs that are bitwise the same.
    """

    seed: int
    final: Score
    curve: tuple[Score, ...]
    training: dict[str, int]
    filled: int | None
    digest: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        shallow = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return {**shallow, "final": self.final.to_dict(), "curve": [score.to_dict() for score in self.curve]}


class Digest(Protocol):
    """What hashlib makes."""

    def update(self, data: bytes, /) -> None:
        """Takes in more bytes."""
        ...


def learn_once(skill: SkillWithDemonstrations, course: Course, seed: int) -> LearningRun:
    """Learns by the skill's own specification and judges the result; the same arguments give the same bits."""
    training, curve, digest = Counter[str](), list[Score](), sha256()
    filled: int | None = None

    def watch(learner: Learner, trial: int) -> None:
        nonlocal filled
        if filled is None and learner.eligible > learner.spec.budget:
            filled = trial
        if course.marks and (trial in course.marks or trial == course.trials):
            curve.append(_judge(skill, learner, trial, course.watched, lambda ball: evaluation_rng(seed, ball)))

    learner = _taught(skill, course, seed, training, digest, watch)
    final = _judge(skill, learner, course.trials, course.contexts, lambda ball: fresh_rng(course.judge, ball))
    return LearningRun(seed, final, tuple(curve), dict(training.most_common()), filled, digest.hexdigest())


def taught(skill: SkillWithDemonstrations, course: Course, seed: int, show: Callable[[int], object]) -> Learner:
    """The learner of such a run, before it is judged; `show` is told how many trials were done."""
    return _taught(skill, course, seed, Counter(), sha256(), lambda _, trial: show(trial))


def _taught(
    skill: SkillWithDemonstrations,
    course: Course,
    seed: int,
    training: Counter[str],
    digest: Digest,
    watch: Callable[[Learner, int], object],
) -> Learner:
    learner = Learner(TaskSpec.from_dict({**skill.spec().to_dict(), "seed": seed, **dict(course.settings)}))
    for shown in skill.demonstrations(course.demonstrations, demonstration_rng(seed)):
        learner.report(
            state=shown.state, goal=shown.goal, cost=shown.result.cost, success=True, kind="demonstration",
            outcome=shown.result.outcome,
        )  # fmt: skip
    rng = training_rng(seed, 1)
    for trial in range(course.trials):
        watch(learner, trial)
        # As a worker's ids are: what is asked between is no matter.
        trial_id = training_id(learner.spec.name, seed, 1, trial + 1)
        training[_try(skill, learner, rng, trial_id, digest)] += 1
    watch(learner, course.trials)
    return learner


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
    tally, reasons = Tally(), Counter[str]()
    for ball, goal in enumerate(goals):
        skill.reset(rng(ball))
        result = skill.execute(goal)
        tally.add(success_by_criterion(result.success, result.info))
        reasons[str(result.info.get("reason", "success" if result.success else "failure"))] += 1
    return Score(trials, tally, dict(reasons.most_common()))
