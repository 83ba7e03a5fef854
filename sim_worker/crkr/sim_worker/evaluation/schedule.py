"""A launcher's account of evaluations: gives each epoch to a worker, and to another one if that is lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

from crkr.sim_worker.evaluation.epochs import EpochClock
from crkr.sim_worker.supervisor.processes import Member

__all__ = ["EvaluationDesk"]


@final
@dataclass(slots=True, eq=False)
class _Duty:
    """An epoch that is to be judged: training trials when it was named, who does it, whether the model was asked."""

    trained: int
    member: Member | None = None
    asked: bool = False


@final
class EvaluationDesk:
    """Has epochs judged beside the training.

    Attributes:
        rates: Success rate by criterion of each epoch judged here.
    """

    def __init__(self) -> None:
        self.rates: dict[int, dict[str, float]] = {}
        self._duties: dict[int, _Duty] = {}

    @property
    def holds_up_training(self) -> bool:
        """Whether the first epoch's model must still be asked, before training changes it."""
        return 0 in self._duties and not self._duties[0].asked

    @property
    def unfinished(self) -> int:
        """How many epochs are still to be judged."""
        return len(self._duties)

    def owed_by(self, member: Member) -> bool:
        """Whether a worker has something to judge."""
        return any(duty.member is member for duty in self._duties.values())

    def look(self, clock: EpochClock | None, trained: int, workers: Sequence[Member]) -> None:
        """Gives every epoch that the clock says has ended to the worker with the fewest; no clock names none."""
        for epoch in () if clock is None else clock.ended(trained):
            self._duties[epoch] = _Duty(trained)
        for epoch, duty in sorted(self._duties.items()):
            if duty.member is None and workers:
                load = Counter(id(other.member) for other in self._duties.values())
                duty.member = min(workers, key=lambda worker: load[id(worker)])
                duty.member.order("judge", epoch=epoch, trained=duty.trained)

    def handle(self, event: dict[str, Any]) -> None:
        """Takes an event of a worker; others than evaluations are none of its business."""
        match event:
            case {"event": "judged", "epoch": epoch} if epoch in self._duties:
                self._duties[epoch].asked = True
            case {"event": "evaluated", "epoch": epoch, "rates": rates}:
                self._duties.pop(epoch, None)
                if rates is not None:  # None where another launcher's worker was quicker
                    self.rates[epoch] = rates

    def lose(self, member: Member) -> None:
        """Takes back what a lost worker had to judge."""
        for duty in self._duties.values():
            if duty.member is member:
                duty.member, duty.asked = None, False
