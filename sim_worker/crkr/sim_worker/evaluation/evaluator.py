"""A worker's evaluations: asks the model when an epoch ends, executes the answers between its training trials."""

from __future__ import annotations

import time
from collections import deque
from typing import final

from crkr.client import Task
from crkr.protocol import Conflict, NoSamples, Receipt
from crkr.sim_worker.evaluation.contexts import EpochEvaluation, FixedContexts
from crkr.sim_worker.skill import Skill
from crkr.sim_worker.worker.supervisor_link import SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry

__all__ = ["Evaluator"]


@final
class Evaluator:
    """Executes the model's goals in the fixed contexts of the epochs that the supervisor assigns to this worker."""

    def __init__(
        self, task: Task, skill: Skill, count: int, worker: str, link: SupervisorLink, telemetry: Telemetry
    ) -> None:
        self._task = task
        self._skill = skill
        self._count = count
        self._worker = worker
        self._link = link
        self._telemetry = telemetry
        self._contexts: FixedContexts | None = None
        self._waiting: deque[EpochEvaluation] = deque()

    @property
    def busy(self) -> bool:
        """Whether a context is left to play."""
        return bool(self._waiting)

    def judge(self, epoch: int, trained: int) -> None:
        """Asks the model now; its answers are executed later.

        Args:
            epoch: Which epoch has ended.
            trained: Training trials that were stored then.

        Raises:
            CrkrError: The server refuses, or is away for longer than the patience.
            Stopped: The supervisor wants this process to end.
        """
        if self._contexts is None:
            self._contexts = FixedContexts(self._skill, self._task.spec.seed, self._count)
        states = self._contexts.states
        try:
            answer = self._link.retry_while_away(lambda: self._task.predict(states, worker=self._worker))
        except NoSamples:  # without demonstrations the first epoch has no model
            self._link.send("evaluated", epoch=epoch, rates=None)
            return
        self._waiting.append(EpochEvaluation(self._task, self._contexts, epoch, trained, answer, self._worker))
        self._link.send("judged", epoch=epoch)

    def play_next(self) -> None:
        """Plays one context, if any is left; stores an epoch when it is complete. Raises what `judge` raises."""
        if not self._waiting:
            return
        evaluation = self._waiting[0]
        evaluation.play_next()
        self._link.send("played")
        if evaluation.finished:
            self._waiting.popleft()
            self._store(evaluation)

    def finish(self, patience_s: float) -> None:
        """Plays the remaining contexts while time allows, as an epoch's model is lost after a restart."""
        deadline = time.monotonic() + patience_s
        while self._waiting and time.monotonic() < deadline:
            self.play_next()

    def _store(self, evaluation: EpochEvaluation) -> None:
        """Stores an epoch's evaluation as a whole or not at all."""
        try:
            receipt = self._link.retry_while_away(lambda: self._task.report_trials(evaluation.trials))
        except Conflict:
            # Another supervisor's worker was faster: the epoch is judged, but with other rates.
            self._link.send("evaluated", epoch=evaluation.epoch, rates=None)
            return
        self._show(evaluation, receipt)
        self._link.send("evaluated", epoch=evaluation.epoch, rates=evaluation.rates())

    def _show(self, evaluation: EpochEvaluation, receipt: Receipt) -> None:
        rows = zip(evaluation.trials, receipt.seqs, evaluation.results, strict=True)
        for context, (trial, seq, result) in enumerate(rows):
            self._telemetry.publish(
                trial, seq, trace=result.trace, sigma=evaluation.sigma(context), novelty=evaluation.novelty(context)
            )
