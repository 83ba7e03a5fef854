"""A launcher's dealings with its evaluator: names epochs to it, keeps account, replaces it when it is lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, final

from crkr.sim_worker.epochs import EpochClock
from crkr.sim_worker.fleet import Fleet, Member
from crkr.sim_worker.worker_process import ProcessSettings, run_evaluator

__all__ = ["EvaluationDesk"]

MOST_EVALUATORS: Final = 3


@final
class EvaluationDesk:
    """Has epochs judged beside the training.

    Args:
        fleet: Where the evaluator's process lives.
        settings: What it needs to know.
        clock: Names the epochs that end.
        say: Prints a line for people.

    Attributes:
        rates: Success rate by criterion of each epoch judged.
        problem: Why no more can be judged, or None.
    """

    def __init__(self, fleet: Fleet, settings: ProcessSettings, clock: EpochClock, say: Callable[[str], None]) -> None:
        self.rates: dict[int, dict[str, float]] = {}
        self.problem: str | None = None
        self._fleet = fleet
        self._settings = settings
        self._clock = clock
        self._say = say
        self._evaluator: Member | None = None
        self._started = 0
        self._unasked: set[int] = set()  # the model was not asked yet
        self._unfinished: dict[int, int] = {}  # epoch -> training trials when it was named

    @property
    def holds_up_training(self) -> bool:
        """Whether the first epoch's model must still be asked, before training changes it."""
        return 0 in self._unasked

    @property
    def unfinished(self) -> int:
        """How many epochs are still to be judged."""
        return len(self._unfinished)

    def look(self, trained: int) -> None:
        """Has every epoch judged that has ended by now."""
        for epoch in self._clock.ended(trained):
            self._unasked.add(epoch)
            self._unfinished[epoch] = trained
            self._order(epoch, trained)

    def owns(self, member: Member) -> bool:
        """Whether a member is the evaluator."""
        return member is self._evaluator

    def handle(self, event: dict[str, Any] | None) -> None:
        """Takes an event of the evaluator; None is its end."""
        match event:
            case None:
                self._replace()
            case {"event": "judged", "epoch": epoch}:
                self._unasked.discard(epoch)
            case {"event": "evaluated", "epoch": epoch, "rates": rates}:
                self._unfinished.pop(epoch, None)
                self.rates[epoch] = rates

    def _order(self, epoch: int, trained: int) -> None:
        if self._evaluator is None:
            self._start()
        if self._evaluator is not None:
            self._evaluator.order("judge", epoch=epoch, trained=trained)

    def _start(self) -> None:
        self._started += 1
        identity = self._settings.identity
        named = replace(identity, worker=f"{identity.worker}-eval{self._started}")
        self._evaluator = self._fleet.start("evaluator", run_evaluator, replace(self._settings, identity=named))

    def _replace(self) -> None:
        lost, self._evaluator = self._evaluator, None
        ending = "" if lost is None else lost.ending()
        if self._started == MOST_EVALUATORS:
            self.problem = f"{MOST_EVALUATORS} evaluators were lost; the last one {ending}"
            return
        self._say(f"warning: the evaluator {ending}; another one takes over")
        for epoch, trained in sorted(self._unfinished.items()):
            self._order(epoch, trained)
