"""The learning threads apply committed entries in log order and publish the new models.

Tasks take turns of one step, so that a task with much to learn does not delay the others. A step may be long with
thousands of active samples, or for a change to a long log. A second thread has the tasks with long steps. At most one
thread works on a task at a time.

A trial is learned at once where one robot reports, or somebody waits for it. Where several report, their trials wait
for each other a little, as one step for all of them costs less.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, final

from crkr.learner import Learner, Model
from crkr.protocol import Internal
from crkr.server.learning.lines import Line, Step, WaitingTasks, size
from crkr.server.learning.served_task import ServedTask, apply_entries
from crkr.server.learning.waits import LONGEST_S
from crkr.server.log import Event, LoggedTrial
from crkr.server.metrics.durations import Durations
from crkr.server.queries.queue import shutting_down
from crkr.server.thread_faults import FAULTS, keep_running

__all__ = ["Learning", "Notice"]

Notice = Callable[[ServedTask, Model, Model], None]

_PACE_S: Final = 0.05  # from one step to the next, where several report
_LONG_S: Final = 0.05  # a step this long moves its task to the second thread


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
        self._lines: dict[ServedTask, Line] = {}  # of the tasks that have waiting steps, are held, or were long
        self._lock = threading.Lock()
        self._turns = (WaitingTasks(self._lock), WaitingTasks(self._lock))  # of the first thread, and of the second
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

    def waiting_tasks(self) -> tuple[int, int]:
        """Numbers of the tasks with trials that wait to be learned, and of those with steps that requests wait for."""
        with self._lock:
            lines = self._lines.values()
            return sum(line.trials > 0 for line in lines), sum(line.asked > 0 for line in lines)

    def is_behind(self, task: ServedTask) -> bool:
        """Whether a request would wait too long for the trials before it, also those that nobody waits for."""
        line = self._lines.get(task)
        return line is not None and line.wait_s() > LONGEST_S

    def submit(
        self,
        task: ServedTask,
        entries: Sequence[LoggedTrial] | Event = (),
        done: Callable[[Any, Exception | None], None] | None = None,
    ) -> None:
        """Queue entries, in log order. If that fails, their task learns no more, as those behind them need them.

        Args:
            task: Their task.
            entries: Trials, possibly none, or one event.
            done: Called with the learner's result and the error once the model includes them. The error is `Internal`
                for a fault in learning, or `ShuttingDown`, on the closing thread, if the server ends first.
        """
        failure: Exception | None = None
        try:
            if not self._queue(Step(task, entries, done)):
                failure = shutting_down()
        except BaseException as error:
            failure = task.stop_learning(error) if entries else Internal(f"nothing can be queued: {error!r}")
        if failure is not None and done is not None:
            done(None, failure)

    def _queue(self, step: Step) -> bool:
        """Put a step into its task's line; False after the end."""
        with self._lock:
            if self._closed:
                return False
            line = self._lines.get(step.task)
            if line is None:
                line = self._lines[step.task] = Line(step.task)
            hurried = line.hurried
            line.add(step)
            self._backlog += size(step.entries)
            self._asked += step.done is not None
            if not line.held and not line.lined:
                self._line_up(line)
            elif line.hurried and not hurried:
                self._wake()
            return True

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
            left = [step for line in self._lines.values() for group in line.groups for step in group]
            self._lines.clear()
            self._asked = 0
            self._closed = True
        for step in left:
            if step.done is not None:
                step.done(None, shutting_down())
        return not any(thread.is_alive() for thread in self._threads)

    def _step(self, turns: WaitingTasks) -> bool:
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
            if any(size(step.entries) for step in group):
                line.note_turn()
            self._give_back(line, took_s > _LONG_S if tells else line.long)
        return True

    def _take(self, turns: WaitingTasks) -> tuple[Line, list[Step]] | None:
        """The next step of the next task, joined with the trials right behind it; None at the end."""
        with self._lock:
            while not self._over():
                if (line := turns.next(self._closing)) is not None:
                    break
                turns.changed.wait(max(self._deadline - time.monotonic(), 0.0) if self._closing else turns.rest_s())
            else:
                return None
            turns.lines.remove(line)
            line.held, line.lined = True, False
            trials, asked = line.trials, line.asked
            group = line.take(self._pace_s)
            self._backlog -= trials - line.trials
            self._asked -= asked - line.asked
            return line, group

    def _over(self) -> bool:
        """Whether to stop: closing, and no request waits any more or the deadline has passed."""
        if not self._closing:
            return False
        return time.monotonic() >= self._deadline or not self._asked

    def _give_back(self, line: Line, long: bool) -> None:
        """End a turn: the task moves behind all others."""
        with self._lock:
            line.held, line.long = False, long
            if line.groups:
                self._line_up(line)
            elif not long:
                self._lines.pop(line.task, None)
            if self._closing:
                self._wake()

    def _line_up(self, line: Line) -> None:
        turns = self._turns[line.slow]
        line.since = time.monotonic()
        turns.lines.append(line)
        line.lined = True
        turns.changed.notify()

    def _wake(self) -> None:
        for turns in self._turns:
            turns.changed.notify_all()

    def _apply(self, group: list[Step]) -> None:
        task, before = group[0].task, group[0].task.model
        result, failure = None, None
        try:
            result = _learn(task, group, self.steps, self._relearn)
        except BaseException as error:  # also a panic or exhausted memory: only this task stops
            failure = task.stop_learning(error)
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
    group: list[Step],
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
