"""A worker's second duty: asks the model when an epoch ends, and plays the answers between its training trials."""

from __future__ import annotations

import time
from collections import deque
from typing import final

from crkr.client import Task
from crkr.protocol import Conflict, Receipt
from crkr.sim_worker.evaluation.contexts import Examination, FixedContexts
from crkr.sim_worker.skill import Skill
from crkr.sim_worker.worker.supervisor_link import Orders
from crkr.sim_worker.worker.telemetry import Telemetry

__all__ = ["Evaluator"]


@final
class Evaluator:
    """Plays the fixed contexts of the epochs that the launcher gives to this worker.

    Args:
        task: What is judged.
        skill: Who tries; between two training trials it is free.
        count: Contexts of an epoch.
        worker: Name in the log.
        orders: The line to the launcher.
        telemetry: Where the trials are shown.
    """

    def __init__(self, task: Task, skill: Skill, count: int, worker: str, orders: Orders, telemetry: Telemetry) -> None:
        self._task = task
        self._skill = skill
        self._count = count
        self._worker = worker
        self._orders = orders
        self._telemetry = telemetry
        self._contexts: FixedContexts | None = None
        self._waiting: deque[Examination] = deque()

    @property
    def busy(self) -> bool:
        """Whether there is something left to play."""
        return bool(self._waiting)

    def judge(self, epoch: int, trained: int) -> None:
        """Asks the model now; playing its answers has time.

        Args:
            epoch: Which epoch has ended.
            trained: Training trials that were stored then.

        Raises:
            CrkrError: The server refuses, or is away for longer than the patience.
            Stopped: The launcher wants this process to end.
        """
        if self._contexts is None:
            self._contexts = FixedContexts(self._skill, self._task.spec.seed, self._count)
        states = self._contexts.states
        answer = self._orders.insist(lambda: self._task.predict(states, worker=self._worker))
        self._waiting.append(Examination(self._task, self._contexts, epoch, trained, answer, self._worker))
        self._orders.tell("judged", epoch=epoch)

    def play_next(self) -> None:
        """Plays one context, if any is left; stores an epoch when it is complete. Raises as `judge`."""
        if not self._waiting:
            return
        examination = self._waiting[0]
        examination.play_next()
        self._orders.tell("played")
        if examination.finished:
            self._waiting.popleft()
            self._hand_in(examination)

    def finish(self, patience_s: float) -> None:
        """Plays what is left, as far as the time allows: an epoch's model will be gone after a restart."""
        deadline = time.monotonic() + patience_s
        while self._waiting and time.monotonic() < deadline:
            self.play_next()

    def _hand_in(self, examination: Examination) -> None:
        """Stores an epoch's evaluation whole or not at all, so that a resumed run finds no halves."""
        try:
            receipt = self._orders.insist(lambda: self._task.report_trials(examination.trials))
        except Conflict:
            # Another launcher's worker was quicker: the epoch is judged, but by other rates than these.
            self._orders.tell("evaluated", epoch=examination.epoch, rates=None)
            return
        self._show(examination, receipt)
        self._orders.tell("evaluated", epoch=examination.epoch, rates=examination.rates())

    def _show(self, examination: Examination, receipt: Receipt) -> None:
        rows = zip(examination.trials, receipt.seqs, examination.results, strict=True)
        for ball, (trial, seq, result) in enumerate(rows):
            self._telemetry.publish(
                trial, seq, trace=result.trace, sigma=examination.sigma(ball), novelty=examination.novelty(ball)
            )
