"""A task of two states and two goals: how it is made, taught by awaited calls, and filled by an outbox."""

import asyncio
from collections.abc import Coroutine
from typing import Any
from uuid import UUID, uuid4

import numpy as np

from crkr.client import AsyncTask, Outbox, Task
from crkr.protocol import TaskSpec

PATIENCE_S = 60.0


def specification(name: str = "") -> dict[str, Any]:
    return {
        "name": name or f"jump-{uuid4()}",
        "state": [{"name": name, "low": 0, "high": 1} for name in "xy"],
        "goal": [{"name": name, "low": -1, "high": 1} for name in "gh"],
    }


def task_spec(name: str) -> TaskSpec:
    return TaskSpec.from_dict(specification(name))


async def practise(task: AsyncTask, count: int = 30) -> None:
    rng = np.random.default_rng(1)
    states, goals = rng.uniform(0, 1, (count, 2)), rng.uniform(-1, 1, (count, 2))
    receipt = await task.report(state=states, goal=goals, cost=rng.uniform(0, 1, count), success=True, wait=True)
    assert receipt.accepted == count


def run(program: Coroutine[Any, Any, None]) -> None:
    """In a loop whose own complaints fail the test."""
    complaints: list[dict[str, Any]] = []

    async def watched() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
        await asyncio.wait_for(program, 3 * PATIENCE_S)

    asyncio.run(watched(), debug=True)
    assert not complaints


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
