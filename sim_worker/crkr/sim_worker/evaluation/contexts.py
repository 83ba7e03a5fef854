"""The fixed contexts that a task is judged on, and one epoch's evaluation on them."""

from __future__ import annotations

from typing import final

import numpy as np

from crkr.client import Task
from crkr.client.tally import Tally, success_by_criterion
from crkr.protocol import Array, Prediction, Trial, evaluation_id
from crkr.sim_worker.randomness import evaluation_rng
from crkr.sim_worker.skill import Skill, TrialResult, judged_state

__all__ = ["COST_OF_NOTHING", "EPOCH", "EpochEvaluation", "FixedContexts"]

EPOCH = 50
"""Training trials of an epoch."""

COST_OF_NOTHING = 1.0
"""Cost of an evaluation with a refused goal: the greatest, since the log requires a number."""


@final
class FixedContexts:
    """The same contexts at each epoch, in each run of a task with this seed."""

    def __init__(self, skill: Skill, seed: int, count: int) -> None:
        self._skill = skill
        self._seed = seed
        self.states: Array = np.array(
            [judged_state(skill, context, evaluation_rng(seed, context)) for context in range(count)]
        )

    def execute(self, context: int, goal: Array) -> TrialResult:
        """Tries a goal (p,) in context number `context`."""
        judged_state(self._skill, context, evaluation_rng(self._seed, context))
        return self._skill.execute(goal)


@final
class EpochEvaluation:
    """One epoch's evaluation: all goals come from one model version and are executed one by one.

    Args:
        task: What is judged.
        contexts: The fixed contexts.
        epoch: Which epoch has ended.
        trained: Training trials that were stored when the model was asked.
        answer: The model's answer to all contexts, (b, p) goals.
        worker: Name in the log.
    """

    def __init__(
        self, task: Task, contexts: FixedContexts, epoch: int, trained: int, answer: Prediction, worker: str
    ) -> None:
        self.epoch = epoch
        self._task = task
        self._contexts = contexts
        self._trained = trained
        self._answer = answer
        self._worker = worker
        self.trials: list[Trial] = []
        self.results: list[TrialResult] = []

    @property
    def finished(self) -> bool:
        """Whether every context was played."""
        return len(self.trials) == len(self._contexts.states)

    def rates(self) -> dict[str, float]:
        """Success rate so far, by criterion."""
        tally = Tally()
        for trial in self.trials:
            tally.add(success_by_criterion(trial.success, trial.info))
        return tally.rates()

    def play_next(self) -> None:
        """Plays the next context."""
        context = len(self.trials)
        goal = self._answer.goals[context]
        result = self._contexts.execute(context, goal)
        self.results.append(result)
        self.trials.append(
            Trial.create(
                self._task.spec,
                id=evaluation_id(self._task.name, self.epoch, context),
                state=self._contexts.states[context],
                goal=goal,
                cost=COST_OF_NOTHING if result.cost is None else result.cost,
                success=result.success,
                kind="evaluation",
                outcome=result.outcome,
                worker=self._worker,
                model_version=self._answer.model_version,
                info={
                    **self._answer.expectation(context),
                    **result.info,
                    "epoch": self.epoch,
                    "ball": context,
                    "trained": self._trained,
                },
            )
        )

    def novelty(self, context: int) -> float:
        """How far the context is from the samples, in [0, 1]."""
        return float(self._answer.novelty[context])

    def sigma(self, context: int) -> Array:
        """(p,) predictive standard deviations of the goal there."""
        return np.asarray(self._answer.sigmas[context])
