"""What `crkr bench sim --skill throw` measures: throws beside strokes of table tennis, contact beside formulas."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np

from crkr.experiments.bench.measurements import Measurement, ratio
from crkr.experiments.bench.sim import agreement, timed, training_run, verdicts
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis
from crkr.sim_worker.throw import Throw

__all__ = ["measure"]

_SHOWN: Final = 20  # planned strokes that the throws are timed beside
_LANDING: Final = slice(0, 2)


def measure(trials: int, seed: int) -> Iterator[Measurement]:
    """All figures, in turn, of `trials` throws of a run with a seed."""
    throws, strokes = Throw(SkillOptions(seed=seed), traces=False), TableTennis(SkillOptions(), traces=False)
    exact = Throw(SkillOptions(environment="analytic"), traces=False)
    run = training_run(throws, trials, seed)
    shown = strokes.demonstrations(_SHOWN, np.random.default_rng(seed))
    ms = dict.fromkeys(("throw", "analytic throw", "stroke"), 0.0)
    for place, (state, goal) in enumerate(zip(run.balls, run.goals, strict=True)):
        other = shown[place % len(shown)]
        calls = {
            "throw": partial(throws.attempt, state, goal),
            "analytic throw": partial(exact.attempt, state, goal),
            "stroke": partial(strokes.attempt, other.state, other.goal),
        }
        for name, call in calls.items():
            ms[name] += 1e3 * timed(call) / len(run.goals)
    yield ratio("a contact trial of the throw / of table tennis", ms, "throw", "stroke", 1.0, unit="ms")
    yield ratio("an analytic throw / a contact one", ms, "analytic throw", "throw", unit="ms")
    yield agreement("contact", *verdicts(throws, run, _LANDING), *verdicts(exact, run, _LANDING))
