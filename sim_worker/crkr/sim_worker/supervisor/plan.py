"""The plan of one run of `crkr workers`, and its report."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from crkr.sim_worker.skill import SkillOptions

__all__ = ["RunPlan", "RunReport"]


@final
@dataclass(frozen=True, slots=True)
class RunPlan:
    """A supervisor's settings.

    Attributes:
        skill: Name of the skill.
        options: How each process makes it.
        endpoint: Where the server is.
        zenoh_config: Transport settings, or None.
        workers: Number of processes that train and judge.
        total: Total training trials of the task; None runs until stopped.
        demonstrations: Number that the task must have before training.
        evaluations: Fixed contexts to judge after each epoch; 0 judges nothing.
        seed: Seed of demonstrations and workers.
        timeout_s: Deadline of a call; it is repeated within the patience [s].
        patience_s: How long the server may be away [s].
        stall_s: Longest time without progress of a worker with work, not counting its calls [s].
        wait: Reports return when the model includes the trial.
        log_level: For the processes.
        fresh: Delete an existing task and start again.
    """

    skill: str
    options: SkillOptions
    endpoint: str
    zenoh_config: Path | None
    workers: int
    total: int | None
    demonstrations: int
    evaluations: int
    seed: int
    timeout_s: float
    patience_s: float
    stall_s: float
    wait: bool
    log_level: str
    fresh: bool = False


@final
@dataclass(slots=True)
class RunReport:
    """The report of a supervisor.

    Attributes:
        task: Name of the task.
        workers: Number of processes started.
        trials: Training trials that its workers stored.
        successes: Number of these that succeeded.
        demonstrations: Number that it added.
        epochs: Success rate by criterion of each epoch that it judged.
        trained: Training trials of the task at the end, as far as known.
        workers_lost: Number that ended too early.
        problem: Why it could not finish, or None.
        stopped_by: The signal that ended it, or None.
        seconds: From the first process's start to the end [s].
    """

    task: str
    workers: int
    trials: int = 0
    successes: int = 0
    demonstrations: int = 0
    epochs: dict[int, dict[str, float]] = field(default_factory=dict)
    trained: int = 0
    workers_lost: int = 0
    problem: str | None = None
    stopped_by: signal.Signals | None = None
    seconds: float = 0.0

    @classmethod
    def merged(cls, task: str, workers: int, reports: Sequence[RunReport]) -> RunReport:
        """The joint report of several supervisors; `trained` and `seconds` are the largest, `problem` the first."""
        return cls(
            task,
            workers,
            trials=sum(one.trials for one in reports),
            successes=sum(one.successes for one in reports),
            demonstrations=sum(one.demonstrations for one in reports),
            epochs={epoch: rates for one in reports for epoch, rates in one.epochs.items()},
            trained=max((one.trained for one in reports), default=0),
            workers_lost=sum(one.workers_lost for one in reports),
            problem=next((one.problem for one in reports if one.problem is not None), None),
            seconds=max((one.seconds for one in reports), default=0.0),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "task": self.task,
            "workers": self.workers,
            "workers_lost": self.workers_lost,
            "trials": self.trials,
            "successes": self.successes,
            "demonstrations": self.demonstrations,
            "epochs": [{"epoch": epoch, **rates} for epoch, rates in sorted(self.epochs.items())],
            "trained": self.trained,
            "stopped_by": None if self.stopped_by is None else self.stopped_by.name,
            "problem": self.problem,
            "seconds": self.seconds,
        }

    def sentence(self) -> str:
        """The report as text."""
        rate = f" ({self.successes} successful)" if self.trials else ""
        parts = [f"{self.trials} trials{rate}"]
        if self.demonstrations:
            parts.append(f"{self.demonstrations} demonstrations")
        if self.epochs:
            last = max(self.epochs)
            marks = ", ".join(f"{name} {value:.0%}" for name, value in self.epochs[last].items())
            parts.append(f"{len(self.epochs)} epochs judged (epoch {last}: {marks})")
        return f"{', '.join(parts)} in {self.seconds:.1f} s; task {self.task} holds {self.trained} training trials"
