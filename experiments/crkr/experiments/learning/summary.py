"""What several runs of learning amount to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.stats import t as student

from crkr.experiments.learning.run import LearningRun

__all__ = ["Summary", "mean_interval", "summarise"]


@final
@dataclass(frozen=True, slots=True)
class Summary:
    """One criterion over all runs.

    Attributes:
        mean: Success rate, mean of the runs.
        interval: 95 % interval of that mean for other seeds; None from a single run.
        worst: Of the runs.
        worst_seed: Which run that was.
        oracle: The planner's rate on the same contexts; None if it was not asked.
    """

    mean: float
    interval: tuple[float, float] | None
    worst: float
    worst_seed: int
    oracle: float | None


def summarise(runs: Sequence[LearningRun], criterion: str, oracle: float | None) -> Summary:
    """The final judgements of all runs that were judged by a criterion, of which there must be one."""
    judged = [run for run in runs if run.final.tally.judged[criterion]]
    rates = np.array([run.final.tally.rate(criterion) for run in judged])
    last = int(np.argmin(rates))
    return Summary(float(rates.mean()), mean_interval(rates), float(rates[last]), judged[last].seed, oracle)


def mean_interval(rates: np.ndarray) -> tuple[float, float] | None:
    """Student's 95 % interval of the mean of independent runs (n,), within [0, 1]; None for fewer than two."""
    if len(rates) < 2:
        return None
    half = float(student.ppf(0.975, len(rates) - 1) * rates.std(ddof=1) / np.sqrt(len(rates)))
    return max(0.0, float(rates.mean()) - half), min(1.0, float(rates.mean()) + half)
