"""A task whose local copies are looked at: how it is made and taught, and how two of its answers compare."""

from typing import Any
from uuid import UUID, uuid4

import numpy as np

from crkr.client import Task
from crkr.protocol import Prediction, TaskSpec

PROBES = np.random.default_rng(1).uniform(-0.2, 1.2, (40, 2))
IDS = [UUID(int=number) for number in range(1, 41)]


def specification(**settings: Any) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": f"putt-{uuid4()}",
            "state": [{"name": name, "low": 0, "high": 1} for name in "xy"],
            "goal": [{"name": name, "low": -1, "high": 1} for name in "ghi"],
            "seed": 7,
            **settings,
        }
    )


def practise(task: Task, count: int, seed: int) -> int:
    """Reports successes, waits until they are learned, and returns the last log position."""
    rng = np.random.default_rng(seed)
    receipt = task.report(
        state=rng.uniform(0, 1, (count, 2)),
        goal=rng.uniform(-0.9, 0.9, (count, 3)),
        cost=rng.uniform(0, 1, count),
        success=True,
        wait=True,
    )
    return receipt.seqs[-1]


def assert_alike(one: Prediction, other: Prediction) -> None:
    for name in ("states", "goals", "means", "sigmas", "novelty"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=1e-9, err_msg=name)
    for name in ("trial_ids", "model_version", "active", "policy"):
        assert getattr(one, name) == getattr(other, name), name
