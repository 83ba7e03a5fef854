"""A task whose reports go by way of an outbox: what is put in, and what the server has."""

from uuid import UUID

import numpy as np

from crkr.client import Outbox, Task
from crkr.protocol import TaskSpec


def specification(name: str) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": name,
            "state": [{"name": name, "low": 0, "high": 1} for name in "xy"],
            "goal": [{"name": name, "low": -1, "high": 1} for name in "gh"],
        }
    )


def put(outbox: Outbox, count: int, seed: int = 0) -> list[UUID]:
    """Reports `count` trials one by one; their ids."""
    rng = np.random.default_rng(seed)
    return [
        outbox.report(
            state=rng.uniform(0, 1, 2), goal=rng.uniform(-1, 1, 2), cost=0.5, success=bool(rng.integers(2)), worker="w"
        )[0]
        for _ in range(count)
    ]


def stored(task: Task) -> list[UUID]:
    return [entry.trial.id for entry in task.iter_samples()]
