"""Judges a task beside its training: asks the model when an epoch ends, and plays the answers as time permits."""

from __future__ import annotations

from collections import deque
from typing import Any, final

from crkr.client import Task
from crkr.protocol import Conflict, Receipt
from crkr.sim_worker.evaluation import Examination, FixedContexts
from crkr.sim_worker.orders import Orders
from crkr.sim_worker.skill import Skill
from crkr.sim_worker.telemetry import Telemetry

__all__ = ["Evaluator"]


@final
class Evaluator:
    """Plays the fixed contexts of each epoch that the launcher names.

    Args:
        task: What is judged.
        skill: Who tries.
        count: Contexts of an epoch.
        worker: Name in the log.
        orders: Names the epochs.
    """

    def __init__(self, task: Task, skill: Skill, count: int, worker: str, orders: Orders) -> None:
        self._task = task
        self._worker = worker
        self._orders = orders
        self._contexts = FixedContexts(skill, task.spec.seed, count)
        self._telemetry = Telemetry(task, skill.scene())
        self._waiting: deque[Examination] = deque()

    def run(self) -> None:
        """Judges until told to stop.

        Raises:
            CrkrError: The server refuses, or is away for longer than the patience.
            Stopped, LineClosed: The end.
        """
        while True:
            while self._orders.waiting() or not self._waiting:
                self._judge(self._orders.next())
            examination = self._waiting[0]
            examination.play_next()
            if examination.finished:
                self._waiting.popleft()
                self._hand_in(examination)

    def _judge(self, order: dict[str, Any]) -> None:
        answer = self._orders.insist(lambda: self._task.predict(self._contexts.states, worker=self._worker))
        epoch, trained = int(order["epoch"]), int(order["trained"])
        self._waiting.append(Examination(self._task, self._contexts, epoch, trained, answer, self._worker))
        self._orders.tell("judged", epoch=epoch)

    def _hand_in(self, examination: Examination) -> None:
        """Stores an epoch's evaluation whole or not at all, so that a resumed run finds no halves."""
        try:
            receipt = self._orders.insist(lambda: self._task.report_trials(examination.trials))
        except Conflict:
            pass  # another launcher's evaluator was quicker: the epoch is judged
        else:
            self._show(examination, receipt)
        self._orders.tell("evaluated", epoch=examination.epoch, rates=examination.rates())

    def _show(self, examination: Examination, receipt: Receipt) -> None:
        rows = zip(examination.trials, receipt.seqs, examination.results, strict=True)
        for ball, (trial, seq, result) in enumerate(rows):
            self._telemetry.publish(
                trial, seq, trace=result.trace, sigma=examination.sigma(ball), novelty=examination.novelty(ball)
            )
