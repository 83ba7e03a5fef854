"""A task for awaited calls: how it is made and taught, and a loop that takes no complaint."""

import asyncio
from collections.abc import Coroutine
from typing import Any
from uuid import uuid4

import numpy as np

from crkr.client import AsyncTask

PATIENCE_S = 20.0


def specification() -> dict[str, Any]:
    return {
        "name": f"jump-{uuid4()}",
        "state": [{"name": name, "low": 0, "high": 1} for name in "xy"],
        "goal": [{"name": name, "low": -1, "high": 1} for name in "gh"],
    }


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
