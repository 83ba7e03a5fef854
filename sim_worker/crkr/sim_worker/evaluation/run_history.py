"""A run's trial counts and epoch scores from its log, for progress, summary and figure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, final

from crkr.client.tally import Tally, stated_epoch, success_by_criterion
from crkr.protocol import StoredTrial, TaskSpec

__all__ = ["EpochScore", "RunHistory"]


@final
@dataclass(slots=True)
class EpochScore:
    """Success of one epoch's model on the fixed contexts.

    Attributes:
        epoch: Its number.
        trials: Training trials that were stored when the model was asked.
        tally: The contexts played so far.
    """

    epoch: int
    trials: int
    tally: Tally = field(default_factory=Tally)

    @property
    def contexts(self) -> int:
        """Contexts played so far."""
        return self.tally.trials

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "epoch": self.epoch,
            "trials": self.trials,
            **self.tally.rates(),
            "contexts": self.contexts,
            "balls": self.contexts,  # the old name, for one release
        }


@final
class RunHistory:
    """Grows by one stored trial at a time, in log order.

    Attributes:
        last_seq: Log position of the newest trial seen.
        kinds: Number of trials of each kind.
        eligible: Number of trials that are learned from.
        filled_at: Training trials when the active set was first full, or None.
    """

    def __init__(self, spec: TaskSpec) -> None:
        self.last_seq = 0
        self.kinds: Counter[str] = Counter()
        self.eligible = 0
        self.filled_at: int | None = None
        self._spec = spec
        self._scores: dict[int, EpochScore] = {}
        self._times: list[float] = []

    @property
    def trained(self) -> int:
        """Training trials: kinds trial and failed."""
        return self.kinds["trial"] + self.kinds["failed"]

    @property
    def samples(self) -> int:
        """All trials in the log."""
        return self.kinds.total()

    @property
    def epochs(self) -> list[EpochScore]:
        """Scores of the epochs judged, in order."""
        return [self._scores[epoch] for epoch in sorted(self._scores)]

    def add(self, stored: StoredTrial) -> None:
        """Adds the next trial of the log."""
        trial = stored.trial
        self.last_seq = stored.seq
        self.kinds[trial.kind] += 1
        if trial.kind == "evaluation":
            self._score(stored)
            return
        if trial.kind != "demonstration":
            self._times.append(stored.time)
        if trial.eligible(self._spec.learn_from):
            self.eligible += 1
            if self.eligible == self._spec.budget:
                self.filled_at = self.trained

    def rate(self, since: int) -> float:
        """Training trials per second by the log's clock, without the first `since`."""
        times = self._times[since:]
        seconds = times[-1] - times[0] if len(times) > 1 else 0.0
        return (len(times) - 1) / seconds if seconds > 0.0 else 0.0

    def _score(self, stored: StoredTrial) -> None:
        info = stored.trial.info
        epoch, trained = stated_epoch(info), info.get("trained")
        if epoch is None:  # recorded by hand
            return
        score = self._scores.setdefault(epoch, EpochScore(epoch, trained if type(trained) is int else 0))
        score.tally.add(success_by_criterion(stored.trial.success, info))
