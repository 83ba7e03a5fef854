"""The schedule of evaluations: which epochs are judged, by which supervisor and which of its workers.

An epoch is 50 training trials. When one ends, the model is asked at the fixed contexts, and its answers are executed
between training trials. `EpochClock` says which epochs have ended. Of the supervisors that train one task, one holds
the role of the judge (`JudgeRole`); another takes over when it ends. `EpochAssignments` gives each epoch to one of the
judge's workers, and to another if that worker is lost.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.client import Client, Role, Task
from crkr.client.tally import stated_epoch
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluation.contexts import EPOCH
from crkr.sim_worker.supervisor.processes import WorkerProcess

__all__ = ["EpochAssignments", "EpochClock", "JudgeRole", "judged_epochs"]

ROLE: Final = "judge"
EVERY_S: Final = 1.0


def judged_epochs(task: Task) -> set[int]:
    """Epochs whose evaluation the log holds."""
    stated = (stated_epoch(stored.trial.info) for stored in task.iter_samples() if stored.trial.kind == "evaluation")
    return {epoch for epoch in stated if epoch is not None}


@final
class EpochClock:
    """Names the epochs that have ended.

    Epoch e ends when the task holds 50 e training trials, epoch 0 before the first. The model of an epoch that ended
    before the start is gone, unless it is the last one.

    Args:
        trained: Training trials stored at the start.
        judged: Epochs that were judged before.
    """

    def __init__(self, trained: int, judged: Collection[int]) -> None:
        self._next = trained // EPOCH
        self._judged = frozenset(judged)

    def ended(self, trained: int) -> list[int]:
        """Epochs that have ended by now, are not judged, and were not named before."""
        newest = trained // EPOCH
        epochs = [epoch for epoch in range(self._next, newest + 1) if epoch not in self._judged]
        self._next = max(self._next, newest + 1)
        return epochs


@final
class JudgeRole:
    """Holds the role of the judge of a task whenever it is free."""

    def __init__(self, client: Client, task: Task, say: Callable[[str], None]) -> None:
        self._client = client
        self._task = task
        self._say = say
        self._role: Role | None = None
        self._clock: EpochClock | None = None
        self._next_try = 0.0
        self._follows = False

    @property
    def clock(self) -> EpochClock | None:
        """Names the epochs for this supervisor's workers to judge; None while another supervisor judges."""
        return self._clock

    def update(self, trained: int) -> None:
        """Takes the role if it is free, at most once a second; `trained` are the training trials stored."""
        if time.monotonic() < self._next_try:
            return
        self._next_try = time.monotonic() + EVERY_S
        if self._role is not None and not self._role.is_mine():
            self.close()
        try:
            if self._role is None:
                self._role = self._client.take_role(self._task.name, ROLE, timeout_s=EVERY_S)
            if self._role is not None and self._clock is None:
                self._clock = EpochClock(trained, judged_epochs(self._task))
        except CrkrError:
            return  # the workers, which are more patient, report that the server is away
        if self._follows != (self._clock is None):
            self._follows = self._clock is None
            self._say("another supervisor judges the epochs" if self._follows else "this supervisor judges the epochs")

    def close(self) -> None:
        """Frees the role."""
        if self._role is not None:
            self._role.close()
        self._role = self._clock = None


@final
@dataclass(slots=True, eq=False)
class _Assignment:
    """An epoch to be judged: training trials when it was named, its worker, and whether the model was asked."""

    trained: int
    worker: WorkerProcess | None = None
    asked: bool = False


@final
class EpochAssignments:
    """Which worker judges which epoch.

    Attributes:
        rates: Success rate by criterion of each epoch judged here.
    """

    def __init__(self) -> None:
        self.rates: dict[int, dict[str, float]] = {}
        self._assignments: dict[int, _Assignment] = {}

    @property
    def holds_up_training(self) -> bool:
        """Whether the first epoch's model must still be asked, before training changes it."""
        return 0 in self._assignments and not self._assignments[0].asked

    @property
    def unfinished(self) -> int:
        """Number of epochs left to judge."""
        return len(self._assignments)

    def is_busy(self, worker: WorkerProcess) -> bool:
        """Whether a worker has an epoch to judge."""
        return any(assignment.worker is worker for assignment in self._assignments.values())

    def assign(self, clock: EpochClock | None, trained: int, workers: Sequence[WorkerProcess]) -> None:
        """Gives each ended epoch to the worker with the fewest; without a clock, names no new ones."""
        for epoch in () if clock is None else clock.ended(trained):
            self._assignments[epoch] = _Assignment(trained)
        for epoch, assignment in sorted(self._assignments.items()):
            if assignment.worker is None and workers:
                load = Counter(id(other.worker) for other in self._assignments.values())
                assignment.worker = min(workers, key=lambda worker: load[id(worker)])
                assignment.worker.send("judge", epoch=epoch, trained=assignment.trained)

    def handle(self, event: dict[str, Any]) -> None:
        """Handles a worker's event; ignores events that are not about evaluations."""
        match event:
            case {"event": "judged", "epoch": epoch} if epoch in self._assignments:
                self._assignments[epoch].asked = True
            case {"event": "evaluated", "epoch": epoch, "rates": rates}:
                self._assignments.pop(epoch, None)
                if rates is not None:  # None where another supervisor's worker was faster, or there was no model
                    self.rates[epoch] = rates

    def release(self, worker: WorkerProcess) -> None:
        """Takes the epochs of a lost worker back."""
        for assignment in self._assignments.values():
            if assignment.worker is worker:
                assignment.worker, assignment.asked = None, False
