"""The task of the benchmarks, with d = 6, p = 13 and 250 active samples, and the queries about it."""

from __future__ import annotations

from typing import Any, Final
from uuid import UUID

import numpy as np

from crkr.client import Task
from crkr.protocol import Array, TaskSpec, Trial, pack, task_key

__all__ = [
    "BUDGET",
    "TASK",
    "D",
    "P",
    "bench_spec",
    "explain_payload",
    "fill",
    "key",
    "predict_payload",
    "report_payload",
    "states",
]

D: Final = 6
P: Final = 13
TASK: Final = "bench"
BUDGET: Final = 250
_BATCH: Final = 500


def bench_spec(budget: int = BUDGET) -> TaskSpec:
    """The task that is measured."""
    state = [{"name": f"s{i}", "unit": "m", "low": 0.0, "high": 4.0, "lengthscale": 1.0} for i in range(D)]
    goal = [{"name": f"g{i}", "unit": "rad", "low": -3.0, "high": 3.0, "scale": 1.0} for i in range(P)]
    return TaskSpec.from_dict({"name": TASK, "state": state, "goal": goal, "budget": budget, "seed": 1})


def key(verb: str) -> str:
    """Key of a verb of the task."""
    return task_key(TASK, verb)


def states(count: int) -> Array:
    """(count, d) states."""
    return np.random.default_rng(0).uniform(0.0, 4.0, (count, D))


def fill(task: Task, count: int) -> None:
    """Report `count` eligible trials, and wait until they are learned."""
    spec = bench_spec()
    for first in range(0, count, _BATCH):
        numbers = range(first, min(first + _BATCH, count))
        trials = [Trial.from_wire(_trial_map(number), spec) for number in numbers]
        task.report_trials(trials, wait=True, timeout_s=120.0)


def predict_payload() -> bytes:
    """One state, with an id, as the client sends it."""
    return pack({"states": states(1)[0], "trial_ids": [bytes(range(16))]})


def explain_payload() -> bytes:
    """One state to be explained."""
    return pack({"state": states(1)[0]})


def report_payload(number: int, success: bool = False) -> bytes:
    """A new trial for each number; without success the server learns nothing from it."""
    return pack({"trials": [{**_trial_map(number), "success": success, "worker": "bench"}]})


def _trial_map(number: int) -> dict[str, Any]:
    rng = np.random.default_rng(number)
    goal = rng.uniform(-1.0, 1.0, P)
    return {
        "id": UUID(int=number + 1).bytes,
        "state": rng.uniform(0.0, 4.0, D),
        "goal": goal,
        "cost": float(rng.uniform()),
        "success": True,
        "kind": "trial",
    }
