"""What `crkr bench growth` measures: what learning costs with many samples and trials beside with few.

Both sides of a ratio take turns and are timed by the thread's own clock, so that other load matters little. Samples and
trials are made up; the figures of servers are in `scale`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from time import thread_time
from typing import Final
from uuid import UUID

import numpy as np

from crkr.experiments.bench import scale
from crkr.experiments.bench.measurements import Measurement, in_turns, p50, p99, ratio
from crkr.experiments.bench.workload import BUDGET, D, P, bench_spec
from crkr.learner import Anms, Learner, TrialColumns, accelerate
from crkr.protocol import KINDS, Array, TaskSpec, Trial

__all__ = ["PARTS", "measure", "resident"]

_FEW: Final = 10_000
_MANY: Final = 1_000_000
_MOST: Final = 10_000_000
_FEWEST: Final = 1_000  # trials of the small outcome model
_ROUNDS: Final = 40
_INSERTS: Final = 50  # in a round
_GROUP: Final = 64  # trials that a server learns together


def measure(directory: Path, parts: tuple[str, ...], polls: int = scale.POLLS) -> Iterator[Measurement]:
    """The figures of some parts, in turn."""
    accelerate()
    made: Mapping[str, Callable[[], Iterator[Measurement]]] = {
        "insert": _inserts,
        "ten-million": _ten_million,
        "learn": _learned,
        "guided": _guided,
        "polls": lambda: scale.measure_polls(directory, polls),
        "lag": lambda: scale.measure_lag(directory, _MANY),
        "trials": lambda: scale.measure_trials(directory),
        "places": lambda: scale.measure_places(directory),
    }
    for part in parts:
        yield from made[part]()


PARTS: Final = ("insert", "learn", "guided", "polls", "lag", "trials", "places", "ten-million")


def resident() -> float:
    """Resident memory of this process [bytes]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


def _states(kind: str, first: int, count: int, total: int, rng: np.random.Generator) -> Array:
    """Standardised states (count, d) of the samples from number `first` on."""
    if kind == "random":
        return rng.uniform(0, 4, (count, D))
    if kind == "clustered":
        centres = np.random.default_rng(1).uniform(0, 4, (20, D))
        return centres[rng.integers(0, 20, count)] + 0.1 * rng.normal(size=(count, D))
    drift = 4.0 * np.arange(first, first + count)[:, None] / total
    return np.asarray(drift + 0.3 * rng.normal(size=(count, D)))


def _filled(kind: str, count: int, rng: np.random.Generator) -> Anms:
    anms = Anms(D, BUDGET)
    anms.extend(_states(kind, 0, count, count, rng), rng.uniform(size=count))
    return anms


def _insertion(anms: Anms, kind: str, count: int, rng: np.random.Generator) -> Callable[[], None]:
    """Inserts one new sample a call."""
    calls = _ROUNDS * _INSERTS + 20
    Z, costs = _states(kind, count, calls, count, rng), rng.uniform(size=calls)
    rows = iter(range(calls))

    def insert() -> None:
        row = next(rows)
        anms.extend(Z[row : row + 1], costs[row : row + 1])

    return insert


def _inserts() -> Iterator[Measurement]:
    for kind in ("random", "clustered", "drifting"):
        rng = np.random.default_rng(0)
        calls = {str(count): _insertion(_filled(kind, count, rng), kind, count, rng) for count in (_FEW, _MANY)}
        times = in_turns(calls, _ROUNDS, _INSERTS, thread_time)
        for name, of, bar in (("p50", p50, 4.0), ("p99", p99, 10.0)):
            found = {f"1e{len(count) - 1}": of(taken) for count, taken in times.items()}
            yield ratio(f"one insert {name}, {kind} states: at 1e6 samples / at 1e4", found, "1e6", "1e4", bar)


def _ten_million() -> Iterator[Measurement]:
    rng = np.random.default_rng(0)
    few = _insertion(_filled("random", _FEW, rng), "random", _FEW, rng)
    Z, costs = _states("random", 0, _MOST, _MOST, rng), rng.uniform(size=_MOST)
    before, anms = resident(), Anms(D, BUDGET)
    started = time.process_time()
    anms.rebuild(Z, costs)
    seconds = time.process_time() - started
    yield Measurement(
        "resident bytes a sample, 1e7 samples", (resident() - before) / _MOST, 400.0, behind={"build s": seconds}
    )
    times = in_turns({"1e4": few, "1e7": _insertion(anms, "random", _MOST, rng)}, _ROUNDS, _INSERTS, thread_time)
    found = {name: p50(taken) for name, taken in times.items()}
    yield ratio("one insert p50, random states: at 1e7 samples / at 1e4", found, "1e7", "1e4", 6.0)


def _columns(spec: TaskSpec, first: int, count: int, rng: np.random.Generator) -> TrialColumns:
    """Made-up trials from a log position on; goals follow the state, outcomes both, and a third of them fail."""
    mixing = np.random.default_rng(1)
    states = rng.uniform(0, 4, (count, D))
    goals = np.tanh(states @ mixing.normal(size=(D, P)) / 2) + 0.3 * rng.normal(size=(count, P))
    outcomes = np.concatenate([states, goals], axis=1) @ mixing.normal(size=(D + P, max(1, len(spec.outcome)))) / 3
    missed = rng.uniform(size=count) < 1 / 3
    outcomes[missed, -1] = np.nan
    taught = np.array([Trial(UUID(int=1), states[0], goals[0], 0.5, hit).flags for hit in (False, True)], np.uint8)
    return TrialColumns(
        seqs=np.arange(first, first + count),
        ids=rng.bytes(16 * count),
        digests=rng.bytes(16 * count),
        states=states,
        goals=goals,
        costs=rng.uniform(size=count),
        kinds=np.full(count, KINDS.index("trial"), dtype=np.uint8),
        flags=taught[(~missed).astype(np.int64)],
        outcomes=outcomes[:, : len(spec.outcome)],
    )


def _learner(spec: TaskSpec, count: int, rng: np.random.Generator) -> Learner:
    learner = Learner(spec)
    with learner.bulk():
        for first in range(0, count, 100_000):
            learner.apply_columns(_columns(spec, first + 2, min(100_000, count - first), rng))
    return learner


def _learned() -> Iterator[Measurement]:
    """Successes learned per second of a core, in groups as under load."""
    rng = np.random.default_rng(0)
    learners = {count: _learner(bench_spec(), count, rng) for count in (_FEW, _MANY)}

    def step(learner: Learner) -> None:
        states, goals, costs = rng.uniform(0, 4, (_GROUP, D)), rng.uniform(-1, 1, (_GROUP, P)), rng.uniform(size=_GROUP)
        ids = [UUID(bytes=rng.bytes(16)) for _ in range(_GROUP)]
        rows = zip(ids, states, goals, costs.tolist(), strict=True)
        trials = [Trial(one, state, goal, cost, True) for one, state, goal, cost in rows]
        started = thread_time()
        learner.apply_trials(range(learner.version + 1, learner.version + 1 + _GROUP), trials)
        taken[id(learner)].append(thread_time() - started)

    taken: dict[int, list[float]] = {id(learner): [] for learner in learners.values()}
    for _ in range(_ROUNDS):
        for learner in learners.values():
            step(learner)
    few, many = (1e6 * float(np.median(taken[id(learner)])) / _GROUP for learner in learners.values())
    behind = {"us at 1e6": many, "us at 1e4": few, "a second at 1e4": 1e6 / few}
    yield Measurement("successes learned a second of a core at 1e6 samples, by 64", 1e6 / many, 2000.0, True, behind)
    yield Measurement("  share of a core that 1000 successes a second take at 1e6", many / 1e3, 1.0)


def _guided() -> Iterator[Measurement]:
    outcome = [
        {"name": f"o{i}", "unit": "m", "tolerance": 0.1, "group": "hit" if i < 3 else "landing"} for i in range(5)
    ]
    spec = TaskSpec.from_dict({**bench_spec().to_dict(), "outcome": outcome, "exploration": {"type": "outcome"}})
    rng = np.random.default_rng(0)
    learners = {f"1e{len(str(count)) - 1}": _learner(spec, count, rng) for count in (_FEWEST, _MANY)}
    states = rng.uniform(0, 4, (_ROUNDS * 10 + 20, D))
    for explore in (False, True):
        calls = {name: _asking(learner, states, explore) for name, learner in learners.items()}
        found = {name: p50(taken) for name, taken in in_turns(calls, _ROUNDS, 10, thread_time).items()}
        what = "exploring" if explore else "best"
        yield ratio(f"guided prediction p50, {what}: 1e6 observed trials / 1e3", found, "1e6", "1e3", 1.5)


def _asking(learner: Learner, states: Array, explore: bool) -> Callable[[], object]:
    rows = iter(states)
    return lambda: learner.predict(next(rows), explore)
