"""The learning threads apply committed entries in log order and publish the new models.

Tasks take turns of one step, so that a task with much to learn does not delay the others. A step may be long with
thousands of active samples, or for a change to a long log. A second thread has the tasks with long steps. At most one
thread works on a task at a time.

A trial is learned at once where one robot reports, or somebody waits for it. Where several report, their trials wait
for each other a little, as one step for all of them costs less.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, final

from crkr.learner import Learner, Model
from crkr.protocol import Internal
from crkr.server.learning.tasks import ServedTask, apply_entries
from crkr.server.log import Event, LoggedTrial
from crkr.server.metrics.durations import Durations
from crkr.server.queries.queue import shutting_down
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["Learning", "Notice"]

logger = logging.getLogger(__name__)

Notice = Callable[[ServedTask, Model, Model], None]

_MOST_TRIALS: Final = 64  # trials of a group, which makes one new model
_PACE_S: Final = 0.05  # from one step to the next, where several report
_LONG_S: Final = 0.05  # a step this long moves its task to the second thread
_LONG_LOG: Final = 5000  # entries from which on an event may take as long


@final
@dataclass(frozen=True, slots=True)
class _Step:
    """Entries of one task, and the callback for when its model includes them."""

    task: ServedTask
    entries: Sequence[LoggedTrial] | Event
    done: Callable[[Any, Exception | None], None] | None


@final
class _Line:
    """Waiting steps of one task, in log order."""

    __slots__ = ("asked", "held", "hurried", "long", "steps", "task", "trials")

    def __init__(self, task: ServedTask) -> None:
        self.task = task
        self.steps: deque[_Step] = deque()
        self.trials = self.asked = 0  # in the waiting steps
        self.hurried = False  # the waiting steps do not wait for others
        self.held = False  # a thread works on an earlier step
        self.long = False  # the last step with entries was

    def rest_s(self) -> float:
        """How long the waiting steps wait for others [s]."""
        return 0.0 if self.hurried else self.task.rests[0] - time.monotonic()

    def hurries(self, step: _Step) -> bool:
        """Whether a new step and all before it are to be learned at once."""
        if step.done is not None or isinstance(step.entries, Event) or self.trials >= _MOST_TRIALS:
            return True
        return _worker(step) == self.task.rests[1]  # nobody else reports

    @property
    def slow(self) -> bool:
        """Whether the next step will probably be long."""
        prepared = self.task.model.explorer.prepare()  # if not, the step first computes what a restart left out
        return self.long or not prepared or (isinstance(self.steps[0].entries, Event) and self.task.seq > _LONG_LOG)


@final
class _WaitingTasks:
    """The tasks that wait for one thread, the next one first."""

    __slots__ = ("changed", "lines")

    def __init__(self, lock: threading.Lock) -> None:
        self.lines: deque[_Line] = deque()
        self.changed = threading.Condition(lock)

    def next(self, hurried: bool) -> _Line | None:
        """The first task whose steps wait for no others, or with `hurried` the first of all."""
        return next((line for line in self.lines if hurried or line.rest_s() <= 0.0), None)

    def rest_s(self) -> float | None:
        """How long until there is one [s]; None: no task waits."""
        return min((max(line.rest_s(), 0.0) for line in self.lines), default=None)


@final
class Learning:
    """The learning threads, which own every learner once the server runs.

    Args:
        notice: Called with task, old model and new model. Two threads may call it at once, for different tasks.
        due: Called with each task for which a fit is due.
        drifted: Called once with each task whose robot has changed, before the restart of its outcome model.
        relearn: Rebuilds the learner that a rollback goes back to.
        pace_s: From one step of a task to the next, where several report and nobody waits for their trials.

    Attributes:
        steps: Times of the learning steps, new model included.
    """

    def __init__(
        self,
        notice: Notice,
        due: Callable[[ServedTask], None],
        drifted: Callable[[ServedTask], None],
        relearn: Callable[[ServedTask, Event], Learner] | None = None,
        pace_s: float = _PACE_S,
    ) -> None:
        text = "Steps of learning, each with a new model."
        self.steps: Final = Durations("crkr_learning_step_duration_seconds", text)
        self._notice, self._due, self._drifted, self._relearn = notice, due, drifted, relearn
        self._pace_s = pace_s
        self._lines: dict[ServedTask, _Line] = {}  # of the tasks that have waiting steps, are held, or were long
        self._lock = threading.Lock()
        self._turns = (_WaitingTasks(self._lock), _WaitingTasks(self._lock))  # of the first thread, and of the second
        self._closing = self._closed = False
        self._deadline = 0.0  # on the monotonic clock, of what is done while closing
        self._backlog = self._asked = 0
        self._threads = [
            threading.Thread(target=keep_running, args=(partial(self._step, turns),), name=name, daemon=True)
            for name, turns in zip(("learning", "long learning"), self._turns, strict=True)
        ]

    def start(self) -> None:
        """Begin to learn."""
        for thread in self._threads:
            thread.start()

    @property
    def backlog(self) -> int:
        """Number of committed trials that wait to be learned."""
        return self._backlog

    @property
    def asked(self) -> int:
        """Number of steps that requests wait for."""
        return self._asked

    def waiting(self, task: ServedTask) -> tuple[int, int]:
        """Numbers of the task's trials that wait to be learned, and of its steps that requests wait for."""
        line = self._lines.get(task)
        return (0, 0) if line is None else (line.trials, line.asked)

    def submit(
        self,
        task: ServedTask,
        entries: Sequence[LoggedTrial] | Event = (),
        done: Callable[[Any, Exception | None], None] | None = None,
    ) -> None:
        """Queue entries, in log order.

        Args:
            task: Their task.
            entries: Trials, possibly none, or one event.
            done: Called with the learner's result and the error once the model includes them. The error is `Internal`
                for a fault in learning, or `ShuttingDown`, on the closing thread, if the server ends first.
        """
        with self._lock:
            if not self._closed:
                line = self._lines.get(task)
                if line is None:
                    line = self._lines[task] = _Line(task)
                step, hurried = _Step(task, entries, done), line.hurried
                line.steps.append(step)
                line.trials += _size(entries)
                line.hurried = hurried or line.hurries(step)
                line.asked += done is not None
                self._backlog += _size(entries)
                self._asked += done is not None
                if len(line.steps) == 1 and not line.held:
                    self._line_up(line)
                elif line.hurried and not hurried:
                    self._wake()
                return
        if done is not None:
            done(None, shutting_down())

    def close(self, patience_s: float) -> bool:
        """Stop once no request waits, after `patience_s` / 2 at the latest; then those left get `ShuttingDown`.

        Entries not yet learned are in the log and will be replayed. False: a running step did not end in time.
        """
        until = time.monotonic() + patience_s
        with self._lock:
            self._closing, self._deadline = True, time.monotonic() + patience_s / 2
            self._wake()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(max(0.0, until - time.monotonic()))
        with self._lock:
            left = [step for line in self._lines.values() for step in line.steps]
            self._lines.clear()
            self._asked = 0
            self._closed = True
        for step in left:
            if step.done is not None:
                step.done(None, shutting_down())
        return not any(thread.is_alive() for thread in self._threads)

    def _step(self, turns: _WaitingTasks) -> bool:
        """One step of the next task; False at the end."""
        taken = self._take(turns)
        if taken is None:
            return False
        line, group = taken
        started = time.monotonic()
        try:
            self._apply(group)
        finally:
            took_s = time.monotonic() - started
            tells = any(step.entries for step in group)  # a question alone is quick whatever the next step takes
            self._give_back(line, took_s > _LONG_S if tells else line.long)
        return True

    def _take(self, turns: _WaitingTasks) -> tuple[_Line, list[_Step]] | None:
        """The next step of the next task, joined with the trials right behind it; None at the end."""
        with self._lock:
            while not self._over():
                if (line := turns.next(self._closing)) is not None:
                    break
                turns.changed.wait(max(self._deadline - time.monotonic(), 0.0) if self._closing else turns.rest_s())
            else:
                return None
            turns.lines.remove(line)
            line.held = True
            steps = line.steps
            group = [steps.popleft()]
            count = _size(group[0].entries)
            while steps and _joins(group[-1], steps[0]) and count < _MOST_TRIALS:
                group.append(steps.popleft())
                count += _size(group[-1].entries)
            line.hurried = bool(steps)
            line.task.rests = time.monotonic() + self._pace_s, _worker(group[-1])
            asked = sum(step.done is not None for step in group)
            line.trials -= count
            line.asked -= asked
            self._backlog -= count
            self._asked -= asked
            return line, group

    def _over(self) -> bool:
        """Whether to stop: closing, and no request waits any more or the deadline has passed."""
        if not self._closing:
            return False
        waited_for = any(step.done is not None for line in self._lines.values() for step in line.steps)
        return time.monotonic() >= self._deadline or not waited_for

    def _give_back(self, line: _Line, long: bool) -> None:
        """End a turn: the task moves behind all others."""
        with self._lock:
            line.held, line.long = False, long
            if line.steps:
                self._line_up(line)
            elif not long:
                self._lines.pop(line.task, None)
            if self._closing:
                self._wake()

    def _line_up(self, line: _Line) -> None:
        turns = self._turns[line.slow]
        turns.lines.append(line)
        turns.changed.notify()

    def _wake(self) -> None:
        for turns in self._turns:
            turns.changed.notify_all()

    def _apply(self, group: list[_Step]) -> None:
        task, before = group[0].task, group[0].task.model
        result, failure = None, None
        try:
            result = _learn(task, group, self.steps, self._relearn)
        except BaseException as error:  # also a panic or exhausted memory: only this task stops
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
            if task.drift is not None and task.drift.due and not task.restarting:
                task.restarting = True
                self._drifted(task)


def _learn(
    task: ServedTask,
    group: list[_Step],
    steps: Durations,
    relearn: Callable[[ServedTask, Event], Learner] | None,
) -> Any:
    """Apply one step, or the trials of several. A failed learner is not used again, as it would skip an entry."""
    entries = group[0].entries
    if not isinstance(entries, Event):
        entries = [entry for step in group if not isinstance(step.entries, Event) for entry in step.entries]
        if not entries:
            return None
    if task.fault:
        raise Internal(task.fault)
    with steps.timing():
        if isinstance(entries, Event) and entries.kind == "rollback" and relearn is not None:
            task.learner = relearn(task, entries)
        result = apply_entries(task.learner, entries)
        task.publish()
        if isinstance(entries, Event) and entries.kind == "restart":
            task.restarting = False
    return result


def _size(entries: Sequence[LoggedTrial] | Event) -> int:
    return 0 if isinstance(entries, Event) else len(entries)


def _worker(step: _Step) -> str | None:
    """The worker of the last trial of a step."""
    return None if isinstance(step.entries, Event) or not step.entries else step.entries[-1].trial.worker


def _joins(step: _Step, following: _Step) -> bool:
    events = isinstance(step.entries, Event) or isinstance(following.entries, Event)
    return step.task is following.task and not events
