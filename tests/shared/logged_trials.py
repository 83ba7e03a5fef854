"""Trials of one small task, and what a log holds of them."""

from typing import Any
from uuid import UUID

import numpy as np

from crkr.protocol import TaskSpec, Trial
from crkr.server.log import LoggedTrial, TaskLog

AXIS = {"name": "x", "unit": "m", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "reach", "state": [AXIS], "goal": [AXIS, {**AXIS, "name": "y"}]})


def trial(number: int, cost: float | None = 0.5, kind: str = "trial", **changes: Any) -> Trial:
    """A trial that its number determines."""
    rng = np.random.default_rng(number)
    return Trial.create(
        SPEC,
        id=UUID(int=number),
        state=rng.uniform(-1, 1, 1),
        goal=rng.uniform(-1, 1, 2),
        cost=cost,
        success=kind != "failed",
        kind=kind,
        **changes,
    )


def trials_of(log: TaskLog, task: str = "reach") -> list[LoggedTrial]:
    return [entry for entry in log.reads.read(task) if isinstance(entry, LoggedTrial)]
