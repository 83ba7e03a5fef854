"""Writes a log of synthetic trials, to measure a server on a long log.

`crkr bench predict` runs it as `python -m crkr.server.inspection.synthetic_log DIR COUNT`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Final
from uuid import UUID

import numpy as np
import typer

from crkr.protocol import TaskSpec, Trial
from crkr.server.log import PendingReport, SqliteLog

__all__ = ["fill", "main"]

_REPORT: Final = 10_000  # trials in one transaction


def main(directory: Path, count: int) -> None:
    """Read a task's specification as JSON from standard input and give it `count` trials."""
    fill(directory, TaskSpec.from_dict(json.load(sys.stdin)), count)


def fill(directory: Path, spec: TaskSpec, count: int) -> None:
    """Store `count` successful trials with uniform states, goals and costs; the same ones every time."""
    rng = np.random.default_rng(0)
    state = np.array([[axis.low, axis.high] for axis in spec.state]).T
    goal = np.array([[axis.low, axis.high] for axis in spec.goal]).T
    log = SqliteLog(directory)
    try:
        log.create(spec)
        for first in range(0, count, _REPORT):
            numbers = range(first, min(first + _REPORT, count))
            states, goals = (rng.uniform(box[0], box[1], (len(numbers), box.shape[1])) for box in (state, goal))
            costs = rng.uniform(size=len(numbers)).tolist()
            trials = tuple(
                Trial(UUID(int=number + 1), one, tried, cost, True)
                for number, one, tried, cost in zip(numbers, states, goals, costs, strict=True)
            )
            log.append_reports([PendingReport(spec.name, trials)])
    finally:
        log.close()


if __name__ == "__main__":
    typer.run(main)
