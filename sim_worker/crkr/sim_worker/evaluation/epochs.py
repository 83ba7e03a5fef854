"""When an epoch ends, and which epochs are still to be judged."""

from __future__ import annotations

from collections.abc import Collection
from typing import final

from crkr.client import Task
from crkr.client.tally import stated_epoch
from crkr.sim_worker.evaluation.contexts import EPOCH

__all__ = ["EpochClock", "judged_epochs"]


def judged_epochs(task: Task) -> set[int]:
    """Epochs whose evaluation the log holds."""
    stated = (stated_epoch(stored.trial.info) for stored in task.iter_samples() if stored.trial.kind == "evaluation")
    return {epoch for epoch in stated if epoch is not None}


@final
class EpochClock:
    """Says which epochs have ended; epoch e ends when the task holds 50 e training trials, epoch 0 before the first.

    A model of an epoch that ended before the start is gone, unless it is the last one.

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
