"""The cost of learning from outcomes: guided goals, and learning steps beside those of a task without outcomes.

The task has d = 6, p = 13 and 7 outcomes in four groups, as table tennis: one is observed in half of the trials, and a
tenth of the goals is refused. Times are the thread's own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from time import thread_time
from typing import Final
from uuid import UUID

import numpy as np

from crkr.experiments.bench.measurements import Measurement, in_turns, p50
from crkr.experiments.bench.workload import BUDGET, D, P, bench_spec
from crkr.learner import Learner
from crkr.protocol import Array, TaskSpec, Trial

__all__ = ["measure_guided"]

_GROUPS: Final = ("hit", "hit", "hit", "landing", "landing", "time", "clearance")
_OBSERVED: Final = ((500, 1.0), (100_000, 1.5))  # trials, and the most that an answer may take [ms]
_BATCH_MS: Final = 0.35
_TOLERANCE: Final = 0.1
_PAGE: Final = 10_000
_STEPS: Final = 200
_STATES: Final = 1000


def measure_guided() -> Iterator[Measurement]:
    """Answers and steps after few and after many observed trials."""
    rng = np.random.default_rng(0)
    slopes = 0.3 * rng.normal(size=(len(_GROUPS), D + P))
    for count, most in _OBSERVED:
        guided, plain = Learner(_spec(_GROUPS)), Learner(_spec(()))
        for learner in (guided, plain):
            _fill(learner, np.random.default_rng(1), slopes, count)
        yield from _answers(guided, rng, count, most)
        cheap = _trials(rng, slopes, _STEPS, 1e-3)  # better than nearly all, so that most become active
        yield _steps(guided, plain, cheap, count)


def _spec(groups: Sequence[str]) -> TaskSpec:
    outcome = [{"name": f"o{n}", "tolerance": _TOLERANCE, "group": group} for n, group in enumerate(groups)]
    exploration = {"type": "outcome" if groups else "gaussian"}
    return TaskSpec.from_dict({**bench_spec(BUDGET).to_dict(), "outcome": outcome, "exploration": exploration})


def _trials(rng: np.random.Generator, slopes: Array, count: int, share: float = 1.0) -> list[Trial]:
    """Trials of a policy that mostly hits, with scaled costs."""
    away = rng.uniform(-2, 2, (count, D))
    best = -away @ slopes[:, :D].T @ np.linalg.pinv(slopes[:, D:]).T
    goals = np.clip(best + rng.normal(size=(count, P)) * rng.choice([0.02, 0.1, 0.5], (count, 1)), -3, 3)
    outcomes = np.sin(np.concatenate([away, goals], axis=1) @ slopes.T)
    missed = np.abs(outcomes).max(axis=1)
    refused = goals[:, 0] > np.quantile(goals[:, 0], 0.9)
    outcomes[missed > np.median(missed), 3:5] = np.nan
    outcomes[refused, :5] = np.nan
    return [
        Trial(
            UUID(bytes=rng.bytes(16)),
            away[n] + 2.0,
            goals[n],
            None if refused[n] else float(min(missed[n], 1.0)) * share,
            bool(missed[n] < 2 * _TOLERANCE and not refused[n]),
            "failed" if refused[n] else "trial",
            outcomes[n],
        )
        for n in range(count)
    ]


def _fill(learner: Learner, rng: np.random.Generator, slopes: Array, count: int) -> None:
    with learner.bulk():
        for start in range(0, count, _PAGE):
            _apply(learner, _trials(rng, slopes, min(_PAGE, count - start)))


def _apply(learner: Learner, trials: list[Trial]) -> None:
    measured = trials if learner.spec.outcome else [replace(trial, outcome=None) for trial in trials]
    learner.apply_trials(range(learner.version + 1, learner.version + 1 + len(trials)), measured)


def _answers(learner: Learner, rng: np.random.Generator, count: int, most: float) -> Iterator[Measurement]:
    states = rng.uniform(0, 4, (_STATES, D))
    ids, turn = [UUID(bytes=rng.bytes(16)) for _ in states], iter(range(10**9))

    def next_one() -> int:
        return next(turn) % _STATES

    def explored() -> object:
        place = next_one()
        return learner.predict(states[place], explore=True, trial_ids=ids[place])

    calls: dict[str, tuple[str, Callable[[], object], int, float]] = {
        "best": ("a guided answer", lambda: learner.predict(states[next_one()]), 20, most),
        "explored": ("a guided goal to explore", explored, 20, most),
        "batch": (f"{_STATES} states in one call, each", lambda: learner.predict(states), 1, _BATCH_MS),
    }
    for what, call, each, bar in calls.values():
        times = in_turns({"call": call}, 10 if each > 1 else 3, each, thread_time)["call"]
        shared = _STATES if each == 1 else 1
        yield Measurement(f"{what} [ms], {count:,} observed", p50(times) / 1e3 / shared, bar)


def _steps(guided: Learner, plain: Learner, trials: list[Trial], count: int) -> Measurement:
    """Single trials that change the model, learned by both in turns."""
    times = []
    for trial in trials:
        active, took = plain.active_ids, []
        for learner in (guided, plain):
            started = thread_time()
            _apply(learner, [trial])
            took.append(thread_time() - started)
        if plain.active_ids != active:
            times.append(took)
    ours, without = (p50(column) for column in np.array(times).T)
    what = f"a learning step with outcomes / without, {count:,} observed"
    return Measurement(what, ours / without, 2.0, behind={"with us": ours, "without us": without})
