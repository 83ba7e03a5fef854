"""Runs of rivals with the same demonstrations, training contexts and judged contexts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from time import thread_time
from typing import Final, final

from crkr.experiments.learning.run import demonstrated, judge
from crkr.experiments.rivals.forward_models import bayesian_quadratic, ridge_quadratic
from crkr.experiments.rivals.gaussian_processes import global_gp
from crkr.experiments.rivals.policy_search import SuccessRegression, contextual_cma_es, contextual_reps
from crkr.experiments.rivals.rival import Crkr, InitialDesign, Rival
from crkr.experiments.study.rows import Row, judged_row
from crkr.protocol import TaskSpec
from crkr.sim_worker.randomness import fresh_rng, training_rng
from crkr.sim_worker.skill import Skill

__all__ = ["PACKAGES", "RIVALS", "Contest", "train"]

Maker = Callable[[TaskSpec, int], Rival]


def _imported(module: str, name: str, spec: TaskSpec, seed: int) -> Rival:
    rival: Rival = getattr(import_module(f"crkr.experiments.rivals.{module}"), name)(spec, seed)
    return rival


def _later(module: str, name: str) -> Maker:
    """A rival whose library is imported when it is made."""
    return partial(_imported, module, name)


RIVALS: Final[dict[str, Maker]] = {
    "crkr": Crkr,
    "bayesian-quadratic": bayesian_quadratic,
    "ridge-quadratic": ridge_quadratic,
    "global-gp": global_gp,
    "botorch": _later("bayesian_optimisation", "CompositeOptimisation"),
    "success-gp": SuccessRegression,
    "contextual-cma-es": contextual_cma_es,
    "contextual-reps": contextual_reps,
    "sb3-sac": _later("actor_critic", "soft_actor_critic"),
    "sb3-td3": _later("actor_critic", "twin_delayed"),
    "sb3-ppo": _later("actor_critic", "proximal"),
    "pyribs": _later("archive", "EliteArchive"),
    "optuna": _later("black_boxes", "optuna_tpe"),
    "nevergrad": _later("black_boxes", "nevergrad_tbpsa"),
}
PACKAGES: Final = {
    "botorch": "botorch",
    "sb3-sac": "stable_baselines3",
    "sb3-td3": "stable_baselines3",
    "sb3-ppo": "stable_baselines3",
    "pyribs": "ribs",
    "optuna": "optuna",
    "nevergrad": "nevergrad",
}  # of the extra `rivals`, by the rival that needs it


@final
@dataclass(frozen=True, slots=True)
class Contest:
    """The common conditions of all rivals.

    Attributes:
        marks: Numbers of training trials at which the policy is judged, ascending; the last one ends a run.
        contexts: Fresh contexts at each.
        judge: Seed of these contexts.
        demonstrations: Number before the first trial; with 0 a rival starts from random goals.
        criterion: Of success, where the skill has several; None: its last, strictest one.
    """

    marks: tuple[int, ...]
    contexts: int
    judge: int
    demonstrations: int
    criterion: str | None = None


def train(skill: Skill, contest: Contest, learner: Rival, way: str, seed: int) -> tuple[list[Row], float]:
    """Trains a rival, and judges it at every mark.

    Returns:
        Its rows, named `way`, and the processor time of one ask and tell [ms].
    """
    if not contest.demonstrations and not isinstance(learner, Crkr):
        learner = InitialDesign(learner, skill.spec(), seed)
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
