"""Runs of rivals with the same demonstrations, training contexts and judged contexts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import thread_time
from typing import Final, final

from crkr.experiments.learning.run import demonstrated, judge
from crkr.experiments.rivals.forward_models import bayesian_quadratic, ridge_quadratic
from crkr.experiments.rivals.policy_search import SuccessRegression, contextual_cma_es, contextual_reps
from crkr.experiments.rivals.rival import Crkr, Rival
from crkr.experiments.study.rows import Row, judged_row
from crkr.protocol import TaskSpec
from crkr.sim_worker.randomness import fresh_rng, training_rng
from crkr.sim_worker.skill import Skill

__all__ = ["RIVALS", "Contest", "compete", "train"]

RIVALS: Final[dict[str, Callable[[TaskSpec, int], Rival]]] = {
    "crkr": Crkr,
    "bayesian-quadratic": bayesian_quadratic,
    "ridge-quadratic": ridge_quadratic,
    "success-gp": SuccessRegression,
    "contextual-cma-es": contextual_cma_es,
    "contextual-reps": contextual_reps,
}


@final
@dataclass(frozen=True, slots=True)
class Contest:
    """What all rivals are given alike.

    Attributes:
        marks: Numbers of training trials at which the policy is judged, ascending; the last one ends a run.
        contexts: Fresh contexts at each.
        judge: Seed of these contexts.
        demonstrations: Number before the first trial.
        criterion: Of success, where the skill has several; None: its last, strictest one.
    """

    marks: tuple[int, ...]
    contexts: int
    judge: int
    demonstrations: int
    criterion: str | None = None


def compete(skill: Skill, contest: Contest, rival: str, seed: int) -> tuple[list[Row], float]:
    """Trains a rival by its name; see `train`."""
    return train(skill, contest, RIVALS[rival](skill.spec(), seed), rival, seed)


def train(skill: Skill, contest: Contest, learner: Rival, way: str, seed: int) -> tuple[list[Row], float]:
    """Trains a rival, and judges it at every mark.

    Returns:
        Its rows, named `way`, and the processor time of one ask and tell [ms].
    """
    learner.start(demonstrated(skill, contest.demonstrations, seed))
    rng, rows, busy = training_rng(seed, 1), list[Row](), 0.0
    for trial in range(contest.marks[-1] + 1):
        if trial in contest.marks:
            score = judge(skill, learner.policy, trial, contest.contexts, lambda ball: fresh_rng(contest.judge, ball))
            rows.append(judged_row(way, seed, score, contest.criterion))
        if trial == contest.marks[-1]:
            break
        state = skill.reset(rng)
        before = thread_time()
        goal = learner.ask(state)
        asked = thread_time()
        result = skill.execute(goal)
        executed = thread_time()
        learner.tell(state, goal, result)
        busy += thread_time() - executed + asked - before
    return rows, 1e3 * busy / max(1, contest.marks[-1])
