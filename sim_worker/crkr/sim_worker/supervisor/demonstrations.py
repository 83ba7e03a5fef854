"""The first successes: recorded once, however many launchers start together."""

from __future__ import annotations

import numpy as np

from crkr.client import Task
from crkr.protocol import Conflict, Trial, demonstration_id
from crkr.sim_worker.skill import Demonstration, Skill
from crkr.sim_worker.worker.telemetry import Telemetry

__all__ = ["record_demonstrations"]


def record_demonstrations(task: Task, skill: Skill, count: int, rng: np.random.Generator, worker: str) -> int:
    """Makes sure that the task has `count` demonstrations, and says how many of them this call added.

    Their ids are a function of task and index, so a launcher that starts at the same time finds them present.
    Returns after the model includes them.

    Raises:
        CrkrError: The server refuses or does not answer, or the skill cannot demonstrate.
    """
    if task.status()["samples"].get("demonstration", 0) >= count:
        return 0
    telemetry = Telemetry(task, skill.scene())
    added = 0
    for index, demonstration in enumerate(skill.demonstrations(count, rng)):
        trial = _trial(task, index, demonstration, worker)
        try:
            receipt = task.report_trials([trial], wait=True)
        except Conflict:  # present: another launcher, with another seed, was quicker
            continue
        added += receipt.accepted
        telemetry.publish(trial, receipt.seqs[0], trace=demonstration.result.trace)
    return added


def _trial(task: Task, index: int, demonstration: Demonstration, worker: str) -> Trial:
    result = demonstration.result
    return Trial.create(
        task.spec,
        id=demonstration_id(task.name, index),
        state=demonstration.state,
        goal=demonstration.goal,
        cost=result.cost,
        success=result.success,
        kind="demonstration",
        outcome=result.outcome,
        worker=worker,
        info=result.info,
    )
