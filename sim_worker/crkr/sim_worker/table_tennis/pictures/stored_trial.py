"""A trial from a server's log, to be played again."""

from __future__ import annotations

from typing import Final
from uuid import UUID

import numpy as np

from crkr.client import Task
from crkr.protocol import Invalid, Trial
from crkr.sim_worker.skill import Outcome

__all__ = ["compared", "stored_trial"]

SHAPE: Final = (6, 13)  # numbers of a state and of a goal of table tennis


def stored_trial(task: Task, trial_id: UUID) -> Trial:
    """The trial of that id in the log of a task of table tennis.

    Raises:
        Invalid: The task has other states or goals, or no such trial.
    """
    shape = len(task.spec.state), len(task.spec.goal)
    if shape != SHAPE:
        raise Invalid(f"table tennis has states of {SHAPE[0]} and goals of {SHAPE[1]}; task {task.name!r} has {shape}")
    for stored in task.iter_samples():
        if stored.trial.id == trial_id:
            return stored.trial
    raise Invalid(f"task {task.name!r} has no trial {trial_id}; crkr explain and the dashboard show ids")


def compared(trial: Trial, again: Outcome) -> str:
    """Whether playing a trial again gave what was measured the first time, in words."""
    reason, cost = again.info["reason"], again.cost
    if _same(trial, again):
        return f"{reason}, cost {cost:.4f}: to the bit what was measured then"
    before = trial.info.get("reason", "of unknown end")
    told = "no cost" if trial.cost is None else f"cost {trial.cost:.4f}"
    return (
        f"{reason}, cost {cost:.4f}; the log says {before}, {told}: the environment or the skill was another one "
        "(see --environment and --skill)"
    )


def _same(trial: Trial, again: Outcome) -> bool:
    if trial.outcome is not None and again.outcome is not None:  # costs may have been corrected since
        return bool(np.array_equal(trial.outcome, again.outcome, equal_nan=True))
    return trial.cost == again.cost
