"""The task before training: created or joined, with its demonstrations recorded once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from crkr.client import Client, Task
from crkr.protocol import Conflict, TaskSpec, Trial, UnknownTask, demonstration_id
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.skill import Demonstration
from crkr.sim_worker.worker.telemetry import Telemetry

__all__ = ["create_or_join", "delete_if_there", "record_demonstrations"]


def delete_if_there(client: Client, name: str, say: Callable[[str], None]) -> None:
    """Deletes a task, so that it starts again; raises `Conflict` if workers train it."""
    try:
        client.task(name).delete()
    except UnknownTask:
        return
    say(f"deleted the task {name} that was there; the server's log keeps it until crkr purge")


def create_or_join(client: Client, spec: TaskSpec, say: Callable[[str], None], *, its_settings: bool = False) -> Task:
    """The task of this specification; an existing task that differs in its seed only is joined and keeps its seed.

    Args:
        client: Where.
        spec: What is to be learned.
        say: Prints a line for people.
        its_settings: An existing task may have other learning settings, for an edited specification, as long as states,
            goals and outcomes are the same.

    Raises:
        Conflict: The task exists and learns something else; the message names the fields.
    """
    try:
        return client.create_task(spec)
    except Conflict as conflict:
        fields = conflict.details.get("fields")
        if not isinstance(fields, dict) or not fields:
            raise
        task = client.task(spec.name)
        if set(fields) == {"seed"}:
            say(f"task {spec.name} exists and keeps its seed {task.spec.seed}")
            return task
        if its_settings and _axes(task.spec) == _axes(spec):
            say(f"task {spec.name} exists and keeps its own {', '.join(sorted(fields))}")
            return task
        listed = ", ".join(sorted(fields))
        raise Conflict(
            f"task {spec.name!r} exists with another specification; these fields differ: {listed}; "
            "choose another name with --task, the options it was created with, or --fresh to start it again",
            details=conflict.details,
        ) from conflict


def _axes(spec: TaskSpec) -> list[object]:
    """The fields that define the meaning and bounds of a trial's numbers."""
    boxes = [[(axis.name, axis.unit, axis.low, axis.high) for axis in axes] for axes in (spec.state, spec.goal)]
    return [*boxes, [(entry.name, entry.unit) for entry in spec.outcome]]


def record_demonstrations(task: Task, skill: GuardedSkill, count: int, rng: np.random.Generator, worker: str) -> int:
    """Records demonstrations until the task has `count`; returns how many this call added.

    Their ids are a function of task and index, so supervisors that start together record each one once. Returns after
    the model includes them.

    Raises:
        CrkrError: The server refuses or does not answer, or the skill fails.
    """
    if task.status()["samples"].get("demonstration", 0) >= count:
        return 0
    telemetry = Telemetry(task, skill.scene())
    added = 0
    for index, demonstration in enumerate(skill.demonstrations(count, rng)):
        trial = _trial(task, index, demonstration, worker)
        try:
            receipt = task.report_trials([trial], wait=True)
        except Conflict:  # another supervisor, with another seed, was faster
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
