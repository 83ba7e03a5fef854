"""Many runs of learning, spread over processes, and their mean success."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress
from crkr.experiments.learning.run import Course, LearningRun, learn_once
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.places.places import load_places
from crkr.sim_worker.skill import Skill, SkillOptions

__all__ = ["Summary", "learn_many", "mean_interval", "summarise"]


def learn_many(
    skill: str, options: SkillOptions, parts: Sequence[tuple[Course, int]], jobs: int, on: str = "here"
) -> list[LearningRun]:
    """One run for each part, a course and a seed, in order, in `jobs` processes; their number changes no result.

    `on` names the places that run them, `here` or `ray`.
    """
    runs: dict[int, LearningRun] = {}
    with Progress(stderr, "learning", len(parts), "runs") as progress:
        numbered = [(place, *part) for place, part in enumerate(parts)]
        for place, run in load_places(on).spread(skill, options, _learn, numbered, jobs):
            runs[place] = run
            rates = ", ".join(f"{name} {rate:.3f}" for name, rate in run.final.tally.rates().items())
            progress.show(len(runs), f"seed {run.seed}: {rates}", now=True)
    return [runs[place] for place in range(len(parts))]


def _learn(skill: Skill, part: tuple[int, Course, int]) -> tuple[int, LearningRun]:
    place, course, seed = part
    return place, learn_once(GuardedSkill(skill), course, seed)


@final
@dataclass(frozen=True, slots=True)
class Summary:
    """Success by one criterion over all runs.

    Attributes:
        mean: Mean success rate of the runs.
        interval: 95 % interval of that mean; None from a single run.
        worst: Success rate of the worst run.
        worst_seed: Seed of the worst run.
        oracle: The planner's rate on the same contexts; None if it was not played.
    """

    mean: float
    interval: tuple[float, float] | None
    worst: float
    worst_seed: int
    oracle: float | None


def summarise(runs: Sequence[LearningRun], criterion: str, oracle: float | None) -> Summary:
    """The final evaluations of all runs that have a criterion, at least one."""
    judged = [run for run in runs if run.final.tally.judged[criterion]]
    rates = np.array([run.final.tally.rate(criterion) for run in judged])
    last = int(np.argmin(rates))
    return Summary(float(rates.mean()), mean_interval(rates), float(rates[last]), judged[last].seed, oracle)


def mean_interval(rates: np.ndarray) -> tuple[float, float] | None:
    """Student's 95 % interval of the mean of independent runs (n,), within [0, 1]; None for fewer than two."""
    if len(rates) < 2:
        return None
    from scipy.stats import t as student  # a third of a second, which the processes of runs are spared

    half = float(student.ppf(0.975, len(rates) - 1) * rates.std(ddof=1) / np.sqrt(len(rates)))
    return max(0.0, float(rates.mean()) - half), min(1.0, float(rates.mean()) + half)
