"""Success by criterion: of one trial, counts over many, and confidence intervals of rates."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, final

import numpy as np

__all__ = ["Tally", "stated_epoch", "success_by_criterion", "wilson_interval"]

LARGEST_EPOCH: Final = 2**31 - 1
Z95: Final = 1.959963984540054  # the 97.5 % point of the standard normal


def stated_epoch(info: Mapping[str, Any]) -> int | None:
    """The epoch in a trial's info, or None.

    An evaluation without an epoch was made by hand and is not part of the learning curve. Any client may write to the
    log, so everything except a whole number from 0 to 2**31 - 1 counts as None.
    """
    epoch = info.get("epoch")
    return epoch if type(epoch) is int and 0 <= epoch <= LARGEST_EPOCH else None


def success_by_criterion(success: bool, info: Mapping[str, Any]) -> dict[str, bool]:
    """Success by each of the skill's criteria: the truth values in `info["outcomes"]`, else just "success".

    Args:
        success: The criterion that is learned from.
        info: The trial's info.
    """
    outcomes = info.get("outcomes")
    named = outcomes.items() if isinstance(outcomes, Mapping) else ()
    met = {name: bool(value) for name, value in named if isinstance(name, str) and isinstance(value, bool | np.bool_)}
    return met or {"success": success}


@final
@dataclass(slots=True)
class Tally:
    """Counts of trials and successes; a criterion's rate is over the trials that were judged by it.

    Attributes:
        trials: Number of trials.
        judged: By criterion, in order of appearance: number of trials judged by it.
        successes: By criterion: number of these that met it.
    """

    trials: int = 0
    judged: Counter[str] = field(default_factory=Counter)
    successes: Counter[str] = field(default_factory=Counter)

    def add(self, met: Mapping[str, bool]) -> None:
        """Counts a trial, given as the result of `success_by_criterion`."""
        self.trials += 1
        for name, success in met.items():
            self.judged[name] += 1
            self.successes[name] += bool(success)

    def remove(self, met: Mapping[str, bool]) -> None:
        """Removes a trial that was counted."""
        self.trials -= 1
        for name, success in met.items():
            self.judged[name] -= 1
            self.successes[name] -= bool(success)

    @property
    def criteria(self) -> tuple[str, ...]:
        """Criteria with at least one judged trial, in order of appearance."""
        return tuple(name for name, count in self.judged.items() if count > 0)

    def rate(self, criterion: str) -> float:
        """Share of the judged trials that met the criterion; NaN if there are none."""
        judged = self.judged[criterion]
        return self.successes[criterion] / judged if judged else math.nan

    def rates(self) -> dict[str, float]:
        """The rate of every criterion with a judged trial."""
        return {name: self.rate(name) for name in self.criteria}

    def interval(self, criterion: str) -> tuple[float, float]:
        """Wilson's 95 % interval of a rate; (0, 1) without trials."""
        return wilson_interval(self.successes[criterion], self.judged[criterion])

    def intervals(self) -> dict[str, tuple[float, float]]:
        """The interval of every criterion with a judged trial."""
        return {name: self.interval(name) for name in self.criteria}


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Wilson's 95 % score interval for a proportion  [Wilson1927].

    Args:
        successes: Number of successes.
        count: Number of trials; 0 gives (0, 1).
    """
    if count == 0:
        return 0.0, 1.0
    rate, shrink = successes / count, 1.0 + Z95 * Z95 / count
    centre = (rate + Z95 * Z95 / (2 * count)) / shrink
    half = Z95 / shrink * math.sqrt(rate * (1.0 - rate) / count + Z95 * Z95 / (4 * count * count))
    return max(0.0, centre - half), min(1.0, centre + half)
