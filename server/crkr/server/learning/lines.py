"""What waits to be learned: for each task a line of steps in log order, and the tasks that wait for one thread."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.server.learning.served_task import ServedTask
from crkr.server.log import Event, LoggedTrial

__all__ = ["Line", "Step", "WaitingTasks", "size"]

_MOST_TRIALS: Final = 64  # trials of a group, which makes one new model
_WEIGHT: Final = 0.25  # weight of the newest time in the mean
_LONG_LOG: Final = 5000  # entries from which on an event may take as long as a long step


@final
@dataclass(frozen=True, slots=True)
class Step:
    """Entries of one task, and the callback for when its model includes them."""

    task: ServedTask
    entries: Sequence[LoggedTrial] | Event
    done: Callable[[Any, Exception | None], None] | None


@final
class Line:
    """Waiting steps of one task, in log order. Trials right behind each other are a group, which is learned at once."""

    __slots__ = (
        *("_newest", "_turn_s", "asked", "batches", "groups", "held"),
        *("hurried", "lined", "long", "since", "task", "trials"),
    )

    def __init__(self, task: ServedTask) -> None:
        self.task = task
        self.groups: deque[list[Step]] = deque()
        self._newest = 0  # trials of the last group
        self._turn_s: float | None = None  # mean time of a group with trials, other tasks' turns before it included
        self.batches = 0  # waiting groups with trials
        self.since = 0.0  # when the first group, or the one that is learned, began to wait for a thread [s, monotonic]
        self.trials = self.asked = 0  # in the waiting steps
        self.hurried = False  # the waiting steps do not wait for others
        self.held = False  # a thread works on an earlier step
        self.lined = False  # the task waits for a thread
        self.long = False  # the last step with entries was

    def add(self, step: Step) -> None:
        """Put a step at the end. If this raises, nothing is changed."""
        count, hurried = size(step.entries), self.hurried or self._hurries(step)
        if self.groups and self._newest < _MOST_TRIALS and _joins(self.groups[-1][-1], step):
            self.groups[-1].append(step)
            self.batches += count > 0 and not self._newest
            self._newest += count
        else:
            self.groups.append([step])
            self.batches += count > 0
            self._newest = count
        self.trials += count
        self.asked += step.done is not None
        self.hurried = hurried

    def take(self, pace_s: float) -> list[Step]:
        """Remove the first group; the next one waits for others until `pace_s` from now, unless it is hurried."""
        now = time.monotonic()
        self.since = min(now, max(self.since, self.task.rests[0]))  # what it waited for others is no delay
        group = self.groups.popleft()
        count = sum(size(step.entries) for step in group)
        self.trials -= count
        self.batches -= count > 0
        self.asked -= sum(step.done is not None for step in group)
        self.hurried = bool(self.groups)
        self.task.rests = now + pace_s, _worker(group[-1])
        return group

    def note_turn(self) -> None:
        """Note how long a group with trials took, which is learned now."""
        seconds, known = time.monotonic() - self.since, self._turn_s
        self._turn_s = seconds if known is None else known + _WEIGHT * (seconds - known)

    def wait_s(self) -> float:
        """How long a new step waits for the trials before it [s]; 0 where those are one group, which it may join."""
        return max(self.batches - 1, 0) * (self._turn_s or 0.0)

    def rest_s(self) -> float:
        """How long the waiting steps wait for others [s]."""
        return 0.0 if self.hurried else self.task.rests[0] - time.monotonic()

    def _hurries(self, step: Step) -> bool:
        """Whether a new step and all before it are to be learned at once."""
        if step.done is not None or isinstance(step.entries, Event) or self.trials + len(step.entries) >= _MOST_TRIALS:
            return True
        return _worker(step) == self.task.rests[1]  # nobody else reports

    @property
    def slow(self) -> bool:
        """Whether the next step will probably be long."""
        prepared = self.task.model.explorer.prepare()  # if not, the step first computes what a restart left out
        event = isinstance(self.groups[0][0].entries, Event)
        return self.long or not prepared or (event and self.task.seq > _LONG_LOG)


@final
class WaitingTasks:
    """The tasks that wait for one thread, the next one first."""

    __slots__ = ("changed", "lines")

    def __init__(self, lock: threading.Lock) -> None:
        self.lines: deque[Line] = deque()
        self.changed = threading.Condition(lock)

    def next(self, hurried: bool) -> Line | None:
        """The first task whose steps wait for no others, or with `hurried` the first of all."""
        return next((line for line in self.lines if hurried or line.rest_s() <= 0.0), None)

    def rest_s(self) -> float | None:
        """How long until there is one [s]; None: no task waits."""
        return min((max(line.rest_s(), 0.0) for line in self.lines), default=None)


def size(entries: Sequence[LoggedTrial] | Event) -> int:
    """Number of trials."""
    return 0 if isinstance(entries, Event) else len(entries)


def _worker(step: Step) -> str | None:
    """The worker of the last trial of a step."""
    return None if isinstance(step.entries, Event) or not step.entries else step.entries[-1].trial.worker


def _joins(step: Step, following: Step) -> bool:
    return not isinstance(step.entries, Event) and not isinstance(following.entries, Event)
