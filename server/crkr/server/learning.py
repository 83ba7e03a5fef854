"""The learning thread: applies what was committed, in the log's order, and swaps in the new model."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

from crkr.learner import Model
from crkr.protocol import Internal
from crkr.server.applying import apply_entries
from crkr.server.durations import Durations
from crkr.server.lane import shutting_down
from crkr.server.log import Event, LoggedTrial
from crkr.server.tasks import ServedTask
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["Learning", "Notice"]

logger = logging.getLogger(__name__)

Notice = Callable[[ServedTask, Model, Model], None]

_MOST_TRIALS: Final = 64  # a group: one new model for all of them, and the next event is not far


@final
@dataclass(frozen=True, slots=True)
class _Step:
    """Entries of one task, then what to do once its model includes them."""

    task: ServedTask
    entries: Sequence[LoggedTrial] | Event
    done: Callable[[Any, Exception | None], None] | None


@final
class Learning:
    """Owns every learner once the server runs.

    Args:
        notice: Told of each new model: task, the one before, the new one.
        due: Told of each task whose settings ask for a fit now.

    Attributes:
        steps: How long it took to learn what was learned together, the new model included.
    """

    def __init__(self, notice: Notice, due: Callable[[ServedTask], None]) -> None:
        self.steps: Final = Durations()
        self._notice, self._due = notice, due
        self._steps: deque[_Step] = deque()
        self._changed = threading.Condition()
        self._closing = self._closed = False
        self._deadline = 0.0  # on the monotonic clock, of what is done while closing
        self._backlog = self._asked = 0
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="learning", daemon=True)

    def start(self) -> None:
        """Begins to learn."""
        self._thread.start()

    @property
    def backlog(self) -> int:
        """Trials that are committed and wait to be learned from."""
        return self._backlog

    @property
    def asked(self) -> int:
        """Steps that somebody waits to be answered for."""
        return self._asked

    def submit(
        self,
        task: ServedTask,
        entries: Sequence[LoggedTrial] | Event = (),
        done: Callable[[Any, Exception | None], None] | None = None,
    ) -> None:
        """Queues entries in the log's order.

        Args:
            task: Whose they are.
            entries: Trials, none of them too, or one event.
            done: Called when the model includes them, with what the learner returned and what went wrong: `Internal`
                where learning is at fault; `ShuttingDown` where the server ends first, from the thread that ends it.
        """
        with self._changed:
            if not self._closed:
                self._steps.append(_Step(task, entries, done))
                self._backlog += _size(entries)
                self._asked += done is not None
                self._changed.notify()
                return
        if done is not None:
            done(None, shutting_down())

    def close(self, patience_s: float) -> bool:
        """Stops once nobody waits for an answer, for half of `patience_s` at most; then who still waits is told.

        What is left is in the log and will be replayed. False: the step at hand goes on too long.
        """
        with self._changed:
            self._closing, self._deadline = True, time.monotonic() + patience_s / 2
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(patience_s)
        with self._changed:
            left = list(self._steps)
            self._steps.clear()
            self._asked = 0
            self._closed = True
        for step in left:
            if step.done is not None:
                step.done(None, shutting_down())
        return not self._thread.is_alive()

    def _step(self) -> bool:
        group = self._take()
        if group:
            self._apply(group)
        return bool(group)

    def _take(self) -> list[_Step]:
        """The next step, with the trials of the same task that follow it at once."""
        with self._changed:
            while not self._steps and not self._closing:
                self._changed.wait()
            if self._closing and (time.monotonic() >= self._deadline or all(step.done is None for step in self._steps)):
                return []
            group = [self._steps.popleft()]
            count = _size(group[0].entries)
            while self._steps and _joins(group[-1], self._steps[0]) and count < _MOST_TRIALS:
                group.append(self._steps.popleft())
                count += _size(group[-1].entries)
            self._backlog -= count
            self._asked -= sum(step.done is not None for step in group)
            return group

    def _apply(self, group: list[_Step]) -> None:
        task, before = group[0].task, group[0].task.model
        result, failure = None, None
        try:
            result = _learn(task, group, self.steps)
        except BaseException as error:  # a panic or exhausted memory too: this task stops, the others go on
            if not isinstance(error, Exception):
                FAULTS.note(error)
            if not task.fault:
                logger.exception("task %r stops learning after log position %s", task.name, before.version)
            task.fault = task.fault or f"{type(error).__name__}: {error}"
            failure = Internal(f"task {task.name!r} stores trials but learns no more until a restart: {task.fault}")
        for step in group:
            if step.done is not None:
                try:
                    step.done(result, failure)
                except BaseException as error:  # the others are answered
                    FAULTS.note(error)
        if task.model is not before:
            self._notice(task, before, task.model)
            if task.learner.refit_due:
                self._due(task)


def _learn(task: ServedTask, group: list[_Step], steps: Durations) -> Any:
    """Applies one step, or the trials of several; a learner that failed once is left alone, lest it skip an entry."""
    entries = group[0].entries
    if not isinstance(entries, Event):
        entries = [entry for step in group if not isinstance(step.entries, Event) for entry in step.entries]
        if not entries:
            return None
    if task.fault:
        raise Internal(task.fault)
    with steps.timing():
        result = apply_entries(task.learner, entries)
        task.publish()
    return result


def _size(entries: Sequence[LoggedTrial] | Event) -> int:
    return 0 if isinstance(entries, Event) else len(entries)


def _joins(step: _Step, following: _Step) -> bool:
    events = isinstance(step.entries, Event) or isinstance(following.entries, Event)
    return step.task is following.task and not events
