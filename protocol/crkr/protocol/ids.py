"""Ids that every process derives in the same way, so that a repeated message names the same trial."""

from __future__ import annotations

import os
from uuid import NAMESPACE_URL, UUID, uuid5

__all__ = ["demonstration_id", "evaluation_id", "random_ids", "task_id", "training_id"]


def task_id(task: str, text: str) -> UUID:
    """uuid5 of `text` in the task's own namespace, which is uuid5(NAMESPACE_URL, "crkr/" + task)."""
    return uuid5(uuid5(NAMESPACE_URL, f"crkr/{task}"), text)


def demonstration_id(task: str, index: int) -> UUID:
    """Id of demonstration `index`, counted from 0: workers that start together record each once."""
    return task_id(task, f"demo/{index}")


def evaluation_id(task: str, epoch: int, ball: int) -> UUID:
    """Id of the evaluation trial of context `ball` after `epoch`."""
    return task_id(task, f"eval/{epoch}/{ball}")


def training_id(task: str, worker_seed: int, first_seq: int, count: int) -> UUID:
    """Id of a worker's `count`-th training trial; `first_seq` is the log position it found when it started."""
    return task_id(task, f"trial/{worker_seed}/{first_seq}/{count}")


def random_ids(count: int) -> list[bytes]:
    """`count` random UUIDs (version 4) as bytes, from one read of the system's source."""
    data = bytearray(os.urandom(16 * count))
    for start in range(0, 16 * count, 16):
        data[start + 6] = data[start + 6] & 0x0F | 0x40
        data[start + 8] = data[start + 8] & 0x3F | 0x80
    return [bytes(data[start : start + 16]) for start in range(0, 16 * count, 16)]
