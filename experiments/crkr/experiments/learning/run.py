"""One run of learning in one process: demonstrations, training trials, evaluation in fresh contexts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from hashlib import sha256
from typing import Any, Final, final

import numpy as np

from crkr.client.tally import Tally, success_by_criterion
from crkr.experiments.rivals.rival import Crkr
from crkr.learner import Learner
from crkr.protocol import Array, Invalid, NoSamples, TaskSpec
from crkr.sim_worker.randomness import demonstration_rng, evaluation_rng, fresh_rng, training_rng
from crkr.sim_worker.skill import Demonstration, HasDemonstrations, Skill, judged_state

__all__ = ["MARKS", "Course", "LearningRun", "Score", "demonstrated", "judge", "learn_once", "trained_learner"]

MARKS: Final = (0, 25, 50, 100, 200, 300, 500, 750, 1000, 1250)  # much is learned early


@final
@dataclass(frozen=True, slots=True)
class Course:
    """The settings of a run.

    Attributes:
        trials: Training trials, refused goals included.
        contexts: Fresh contexts of the final evaluation.
        judge: Seed of these contexts, the same for every run; `crkr evaluate` with this seed has the same ones.
        demonstrations: Number of demonstrations before the first trial.
        marks: Training trials after which the learning curve has a point, besides the last one; empty: no curve. A
            curve does not change the run.
        watched: Contexts of each of its points, the task's fixed ones.
        settings: Fields of the skill's specification that differ.
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
    """An evaluation of the policy without exploration.

    Attributes:
        trials: Training trials that the policy had learned from.
        tally: The contexts that were played.
        reasons: How they ended, in the skill's words.
    """

    trials: int
    tally: Tally
    reasons: dict[str, int]

    @property
    def contexts(self) -> int:
        """Number of contexts that were played."""
        return self.tally.trials

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        counts = {"judged": dict(self.tally.judged), "successes": dict(self.tally.successes)}
        return {"trials": self.trials, "contexts": self.contexts, **counts, "reasons": self.reasons}


@final
@dataclass(frozen=True, slots=True)
class LearningRun:
    """The result of one seed.

    Attributes:
        seed: Seed of demonstrations, contexts and exploration.
        final: The evaluation after the last trial.
        curve: Scores on fewer contexts during the run, the last one after the last trial; empty without marks.
        training: How the training trials ended, in the skill's words.
        filled: Training trials after which more samples were eligible than the budget; None: never.
        digest: SHA-256 over state, goal and cost of every training trial: equal for bitwise equal runs.
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


def learn_once(skill: Skill, course: Course, seed: int) -> LearningRun:
    """Learn by the skill's specification and evaluate the result; the same arguments give the same bits."""
    training, curve, digest = Counter[str](), list[Score](), sha256()
    filled: int | None = None

    def watch(learner: Learner, trial: int) -> None:
        nonlocal filled
        if filled is None and learner.eligible > learner.spec.budget:
            filled = trial
        if course.marks and (trial in course.marks or trial == course.trials):
            score = judge(skill, _policy(learner), trial, course.watched, lambda context: evaluation_rng(seed, context))
            curve.extend([score] if score.contexts else [])

    learner = _trained_learner(skill, course, seed, training, digest.update, watch)
    final = judge(
        skill, _policy(learner), course.trials, course.contexts, lambda context: fresh_rng(course.judge, context)
    )
    return LearningRun(seed, final, tuple(curve), dict(training.most_common()), filled, digest.hexdigest())


def trained_learner(skill: Skill, course: Course, seed: int, show: Callable[[int], object]) -> Learner:
    """The learner of such a run, before its evaluation; `show` is called with the number of trials done."""
    return _trained_learner(skill, course, seed, Counter(), _ignore, lambda _, trial: show(trial))


def _ignore(_: bytes) -> None:
    """A digest that is not computed."""


def _trained_learner(
    skill: Skill,
    course: Course,
    seed: int,
    training: Counter[str],
    digest: Callable[[bytes], object],
    watch: Callable[[Learner, int], object],
) -> Learner:
    spec = TaskSpec.from_dict({**skill.spec().to_dict(), **dict(course.settings)})
    learned = Crkr(spec, seed)  # with a worker's ids, so that other questions do not change exploration
    learned.start(demonstrated(skill, course.demonstrations, seed))
    rng = training_rng(seed, 1)
    for trial in range(course.trials):
        watch(learned.learner, trial)
        state = skill.reset(rng)
        goal = learned.ask(state)
        result = skill.execute(goal)
        learned.tell(state, goal, result)
        digest(np.array([*state, *goal, np.nan if result.cost is None else result.cost]).tobytes())
        training[result.reason] += 1
    watch(learned.learner, course.trials)
    return learned.learner


def demonstrated(skill: Skill, count: int, seed: int) -> Sequence[Demonstration]:
    """The demonstrations of a seed.

    Raises:
        Invalid: Some are wanted, and the skill has none.
    """
    if not count:
        return ()
    if not isinstance(skill, HasDemonstrations):
        raise Invalid(f"{type(skill).__name__} has no demonstrations (a method `demonstrations`); ask for 0")
    return skill.demonstrations(count, demonstration_rng(seed))


def _policy(learner: Learner) -> Callable[[Array], Array]:
    return lambda states: learner.predict(states).goals


def judge(
    skill: Skill,
    policy: Callable[[Array], Array],
    trials: int,
    contexts: int,
    rng: Callable[[int], np.random.Generator],
) -> Score:
    """Play a policy, states (b, d) to goals (b, p), in contexts drawn by `rng(number)`, without exploration."""
    states = np.array([judged_state(skill, context, rng(context)) for context in range(contexts)])
    try:
        goals = policy(states)
    except NoSamples:  # without demonstrations there is no policy at first
        return Score(trials, Tally(), {"no policy": contexts})
    tally, reasons = Tally(), Counter[str]()
    for context, goal in enumerate(goals):
        judged_state(skill, context, rng(context))
        result = skill.execute(goal)
        tally.add(success_by_criterion(result.success, result.info))
        reasons[result.reason] += 1
    return Score(trials, tally, dict(reasons.most_common()))
