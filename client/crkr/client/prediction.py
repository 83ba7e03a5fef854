"""Asks for predictions: in one message, or in several where one does not hold all the states."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from crkr.client.network.rpc import Rpc, reading
from crkr.protocol import Array, NovelState, Prediction, task_key

__all__ = ["ask", "ask_in_parts"]


def ask(rpc: Rpc, task: str, states: Array, message: Mapping[str, Any], timeout_s: float | None) -> Prediction:
    """The answer to one message of `PredictRequest.to_wire`, which asks about these states."""
    reply = rpc.call(task_key(task, "predict"), message, timeout_s)
    with reading("predict"):
        return Prediction.from_wire(reply, states)


def ask_in_parts(
    rpc: Rpc, task: str, states: Array, message: Mapping[str, Any], most: int, timeout_s: float | None
) -> Prediction:
    """The same with at most `most` states in a message, all by one deadline.

    Raises:
        NovelState: A state is more novel than the task allows; its index counts among all states.
        CrkrError: Whatever else one of the messages meets with.
    """
    deadline, parts = rpc.deadline(timeout_s), []
    for start in range(0, len(states), most):
        end = min(start + most, len(states))
        part = {**message, "states": states[start:end], "trial_ids": message["trial_ids"][start:end]}
        try:
            parts.append(ask(rpc, task, states[start:end], part, max(deadline - time.monotonic(), 0.001)))
        except NovelState as error:
            index = error.details.get("index")
            where = {"index": start + index} if isinstance(index, int) else {}
            told = f"among states {start} to {end - 1}: {error.message}"
            raise NovelState(told, details={**error.details, **where}) from error
    return Prediction.joined(parts)
