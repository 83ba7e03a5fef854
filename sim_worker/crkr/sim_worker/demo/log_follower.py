"""Reads a task's log as it grows, with short deadlines so that the demo never hangs."""

from __future__ import annotations

import time
from collections import deque
from typing import Any, Final, final

from crkr.client import Client, Task
from crkr.protocol import CrkrError, UnknownTask
from crkr.sim_worker.evaluation.run_history import RunHistory

__all__ = ["LogFollower"]

CALL_S: Final = 1.0
STATUS_EVERY_S: Final = 1.0
WINDOW_S: Final = 5.0


@final
class LogFollower:
    """Reads new entries of the log, and the server's status.

    Attributes:
        history: The run so far; None until the task exists.
        trained_before: Training trials stored at `begin`.
        active: Samples in the model.
    """

    def __init__(self, client: Client, task: str) -> None:
        self.history: RunHistory | None = None
        self.trained_before = 0
        self.active = 0
        self._task: Task = client.task(task)
        self._status_due = 0.0
        self._window: deque[tuple[float, int]] = deque()

    @property
    def task(self) -> Task:
        """The task that is followed."""
        return self._task

    def begin(self) -> None:
        """Reads the entries of an earlier run, before this one starts."""
        self.update()
        self.trained_before = 0 if self.history is None else self.history.trained

    def update(self, *, thoroughly: bool = False) -> None:
        """Reads new entries; a server that does not answer is asked again next time.

        Args:
            thoroughly: Also ask for the status, however recent the last one is.
        """
        try:
            if self.history is None:
                self.history = RunHistory(self._task.spec)
            self._read(self.history)
            if thoroughly or time.monotonic() >= self._status_due:
                self.active = int(self._task.status(timeout_s=CALL_S)["active"])
                self._status_due = time.monotonic() + STATUS_EVERY_S
        except UnknownTask:
            self.history = None
        except CrkrError:
            return
        self._window.append((time.monotonic(), self.history.trained if self.history else 0))
        while len(self._window) > 1 and self._window[0][0] < time.monotonic() - WINDOW_S:
            self._window.popleft()

    def remark(self) -> str:
        """Rate, newest scores, active set and samples, for a progress display."""
        if self.history is None:
            return "starting"
        (then, before), (now, trained) = self._window[0], self._window[-1]
        parts = [f"{(trained - before) / (now - then):.0f}/s"] if now > then and trained > before else []
        if self.history.epochs:
            score = self.history.epochs[-1]
            marks = ", ".join(f"{name} {rate:.0%}" for name, rate in score.tally.rates().items())
            parts.append(f"{marks} after {score.trials}")
        parts += [f"active {self.active}", f"samples {self.history.samples}"]
        return ", ".join(parts)

    def result(self) -> dict[str, Any]:
        """The run so far, as plain data for the summary."""
        history = self.history
        if history is None:
            nothing = dict.fromkeys(("trials", "demonstrations", "trials_per_second", "samples"), 0)
            return {**nothing, "success_before": None, "success_after": None, "epochs": []}
        epochs = history.epochs
        return {
            "trials": history.trained,
            "demonstrations": history.kinds["demonstration"],
            "success_before": epochs[0].tally.rates() if epochs and epochs[0].epoch == 0 else None,
            "success_after": epochs[-1].tally.rates() if epochs else None,
            "epochs": [score.to_dict() for score in epochs],
            "trials_per_second": history.rate(since=self.trained_before),
            "samples": history.samples,
        }

    def _read(self, history: RunHistory) -> None:
        position: int | None = history.last_seq
        while position is not None:
            page, position = self._task.samples(position, timeout_s=CALL_S)
            for stored in page:
                history.add(stored)
