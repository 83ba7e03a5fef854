"""What is asked and reported in a bench: a task with d = 6, p = 13 and 250 active samples."""

from __future__ import annotations

from typing import Any, Final
from uuid import UUID

import numpy as np

from crkr.client.task import Task
from crkr.protocol import Array, TaskSpec, Trial, pack, task_key

__all__ = [
    "BUDGET",
    "TASK",
    "D",
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


def bench_spec() -> TaskSpec:
    """The task that is measured."""
    state = [{"name": f"s{i}", "unit": "m", "low": 0.0, "high": 4.0, "lengthscale": 1.0} for i in range(D)]
    goal = [{"name": f"g{i}", "unit": "rad", "low": -3.0, "high": 3.0, "scale": 1.0} for i in range(P)]
    return TaskSpec.from_dict({"name": TASK, "state": state, "goal": goal, "budget": BUDGET, "seed": 1})


def key(verb: str) -> str:
    """Key of a verb of the task."""
    return task_key(TASK, verb)


def states(count: int, seed: int = 0) -> Array:
    """(count, d) states."""
    return np.random.default_rng(seed).uniform(0.0, 4.0, (count, D))


def fill(task: Task, count: int) -> None:
    """Reports `count` trials that the task may learn from, and waits until it has."""
    spec = bench_spec()
    for first in range(0, count, _BATCH):
        numbers = range(first, min(first + _BATCH, count))
        task.report_trials([_trial(spec, number) for number in numbers], wait=True, timeout_s=120.0)


def predict_payload() -> bytes:
    """One state, with an id, as the client sends it."""
    return pack({"states": states(1)[0], "trial_ids": [bytes(range(16))]})


def explain_payload() -> bytes:
    """One state to be explained."""
    return pack({"state": states(1)[0]})


def report_payload(number: int) -> bytes:
    """One trial that nobody reported yet; it failed, so that nothing need be learned from it."""
    return pack({"trials": [{**_map(number), "success": False, "worker": "bench"}]})


def _trial(spec: TaskSpec, number: int) -> Trial:
    return Trial.from_wire(_map(number), spec)


def _map(number: int) -> dict[str, Any]:
    rng = np.random.default_rng(number)
    identity = UUID(int=number + 1).bytes
    goal = rng.uniform(-1.0, 1.0, P)
    return {
        "id": identity,
        "state": rng.uniform(0.0, 4.0, D),
        "goal": goal,
        "cost": float(rng.uniform()),
        "success": True,
        "kind": "trial",
    }
