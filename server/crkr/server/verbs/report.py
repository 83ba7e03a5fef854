"""The writing verbs: commit, then acknowledge, then hand over to learning.

Changes, which may take long, have a lane beside that of reports, and look at the log before they commit.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final, final

from crkr.protocol import (
    Conflict,
    CrkrError,
    Invalid,
    Receipt,
    ReportRequest,
    ShuttingDown,
    StorageError,
    TaskSpec,
    UnknownTask,
    check_model_fits,
    id_from_wire,
    refuse_absurd,
)
from crkr.server.learning.restore import batches
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import Event, PendingReport, Stored, TaskLog
from crkr.server.metrics.durations import Durations
from crkr.server.queries.queue import busy
from crkr.server.queries.request import Job, Request
from crkr.server.thread_faults import FAULTS
from crkr.server.verbs.admin import Change, moved, read_change, refuse_unknown
from crkr.server.verbs.limits import Limits
from crkr.server.verbs.rollback import read_rollback
from crkr.server.verbs.undo import read_undo
from crkr.server.workers import Workers

__all__ = ["MOST_REPORTS", "Writer", "refuse_archived"]

logger = logging.getLogger(__name__)

MOST_REPORTS: Final = 256  # in one commit
_BY_LOG: Final = {"undo": read_undo, "rollback": read_rollback}  # verbs that look up former values
_ATTEMPTS: Final = 8  # at a change whose task is changed meanwhile
_WHERE: Final = frozenset({"rename", "delete"})  # changes of a task's place, not of its learning
_KNOWN_BEFORE: Final = _WHERE | {"archive", "fit"}  # only the learner knows the effect of other changes


@final
class Writer:
    """The work of the lanes that write: `store` for reports in groups, `change` for other requests one by one."""

    def __init__(self, log: TaskLog, tasks: Tasks, workers: Workers, learning: Learning) -> None:
        self.commits: Final = Durations("crkr_commit_duration_seconds", "Durable commits to the task log.")
        self._log, self._tasks, self._workers, self._learning = log, tasks, workers, learning
        self._limits = Limits(learning)
        self._order = threading.Lock()  # from a commit until its entries are queued for learning

    def change(self, requests: list[Request]) -> None:
        """Commit a request that is no report, and answer it, or let learning answer it; one at a time."""
        for request in requests:
            try:
                (self._create if request.verb == "create_task" else self._change)(request)
            except BaseException as error:
                request.fail_unexpectedly(error)

    def store(self, requests: list[Request]) -> None:
        """Commit reports together, and answer each, or let learning answer it."""
        decoded: list[tuple[Request, ServedTask, ReportRequest]] = []
        for request in requests:
            try:
                decoded.append((request, *self._decode(request)))
            except BaseException as error:
                request.fail_unexpectedly(error)
        with self._order:
            self._commit(decoded)

    def _commit(self, decoded: list[tuple[Request, ServedTask, ReportRequest]]) -> None:
        for request, task, _ in decoded:
            try:
                _refuse_deleted(task)  # since its report was read, or
                refuse_archived(task)
            except CrkrError as error:
                request.fail(error)
        decoded = [one for one in decoded if not one[0].answered]
        if not decoded:
            return
        try:
            self._recover()
            pending = [PendingReport(task.name, asked.trials) for _, task, asked in decoded]
            with self.commits.timing():
                results = self._log.append_reports(pending)
        except CrkrError as error:  # STORAGE, or SHUTTING_DOWN where the database is away for now
            level = logging.ERROR if isinstance(error, StorageError) else logging.DEBUG  # the lease reports an outage
            logger.log(level, "reports were not stored: %s", error.message)
            for request, _, _ in decoded:
                request.fail(error)
            return
        for (request, task, asked), result in zip(decoded, results, strict=True):
            try:
                self._acknowledge(request, task, asked, result)
            except BaseException as error:  # it is stored and queued, and those behind it are to be
                _tell(request, error)

    def _decode(self, request: Request) -> tuple[ServedTask, ReportRequest]:
        task = self._tasks.get(request.task)
        refuse_archived(task)
        self._limits.refuse_trials(task)
        asked = ReportRequest.from_wire(request.message(), task.created)
        if asked.wait:  # also for duplicates, which add nothing to the backlog
            self._limits.refuse_waiting(request, task)
        return task, asked

    def _acknowledge(
        self, request: Request, task: ServedTask, asked: ReportRequest, result: Stored | Conflict | ShuttingDown
    ) -> None:
        if not isinstance(result, Stored):
            request.fail(result)
            return
        task.note_all(result.fresh)
        done = None
        try:
            done = self._answer(request, task, asked, result)
        finally:  # it is stored
            if result.fresh or done is not None:
                self._learning.submit(task, result.fresh, done)

    def _answer(
        self, request: Request, task: ServedTask, asked: ReportRequest, result: Stored
    ) -> Callable[[Any, Exception | None], None] | None:
        """Answer a report before the learning thread wakes, which would delay it, or return how learning answers it."""
        for trial in asked.trials:
            if trial.worker is not None:
                self._workers.reported(task.name, trial.worker, (trial.id.bytes,))

        def reply(_: Any = None, failure: Exception | None = None) -> None:
            fresh = len(result.fresh)
            receipt = Receipt(fresh, len(result.seqs) - fresh, result.seqs, task.model.version)
            stored = isinstance(failure, ShuttingDown)  # only the version lags behind
            _settle(request, None if stored else failure, receipt.to_wire())

        if asked.wait:
            return self._limits.hold(request, task, reply)
        reply()
        return None

    def _create(self, request: Request) -> None:
        spec = TaskSpec.from_dict(request.message())
        if spec.name not in self._tasks and not self._tasks.is_elsewhere(spec.name):
            if not self._tasks.creates:
                request.let_go()  # another server makes it
                return
            with suppress(Conflict):  # another server made it just now
                self._make(spec)
                request.reply({"created": True, "spec_hash": spec.fingerprint()})
                return
        task = self._tasks.find(spec.name)
        created = self._created(spec.name) if task is None else task.created
        fields = created.differences(spec)
        if fields:
            raise Conflict(
                f"task {spec.name!r} exists with other {', '.join(fields)}; use its specification or another name",
                details={"fields": fields},
            )
        request.reply({"created": False, "spec_hash": created.fingerprint()})

    def _make(self, spec: TaskSpec) -> None:
        check_model_fits(spec)
        refuse_absurd(spec)
        task = ServedTask(spec)  # raises for unsupported settings, before anything is stored
        with self._order:
            self._tasks.check_room()
            self._recover()
            with self.commits.timing():
                creation = self._log.create(spec)
            task.begin(creation)
            self._tasks.add(task)
        logger.info("created task %s", spec.name)

    def _created(self, name: str) -> TaskSpec:
        """The specification of a task that another server serves, as created."""
        creation = self._log.reads.event(name, 1)
        if creation is None:
            raise StorageError(f"the log of task {name!r} does not begin with its creation; restore a backup")
        return replace(TaskSpec.from_dict(creation.body["spec"]), name=name)

    def hand_over(self, name: str, ready: Callable[[ServedTask], None]) -> None:
        """Take a task out of service for another server; calls `ready` once all stored entries are learned."""
        with self._order:
            task = self._tasks.look(name)
            self._tasks.leave(name)
            self._learning.submit(task, (), lambda _, failure: None if failure else ready(task))

    def _recover(self) -> None:
        """Serve entries whose commit seemed to fail. The caller holds the order."""
        for name, entries in self._log.recover():
            task = self._tasks.look(name)
            for batch in batches(entries, MOST_REPORTS):
                task.note_all([batch] if isinstance(batch, Event) else batch)
                self._learning.submit(task, batch)

    def _change(self, request: Request) -> None:
        message = request.message()
        before = self._tasks.moved(request.verb, request.task, message.get("request"))
        if before is not None:
            request.reply(moved(before))
            return
        task = self._tasks.get(request.task)
        self._limits.refuse_waiting(request, task)
        if request.verb in _BY_LOG:
            self._agree(task, lambda: _BY_LOG[request.verb](message, task, self._log.reads), request)
        else:
            self._agree(task, lambda: read_change(request.verb, message, task), request)

    def commit(self, task: ServedTask, change: Change, request: Job, configured: int | None = None) -> None:
        """Commit a change, and answer the request once the model includes it; thread-safe.

        Raises:
            Conflict: The task was configured after log position `configured`, on which the change is based.
            Invalid: The task is archived, or has no such trial.
        """
        self._agree(task, lambda: change, request, configured)

    def _agree(self, task: ServedTask, make: Callable[[], Change], request: Job, configured: int | None = None) -> None:
        """Make a change of the task as it is, and commit it; it is made again if the task was changed meanwhile."""
        for _ in range(_ATTEMPTS):
            seen, change = task.changed, make()
            body = self._completed(task, change)
            with self._order:
                _refuse_deleted(task)
                self._tasks.look(task.name)  # raises if another server serves it by now
                if configured is not None and task.configured != configured:
                    raise Conflict(f"task {task.name!r} was configured again meanwhile; ask again")
                self._recover()
                if task.changed == seen:
                    self._commit_change(task, change, body, request)
                    return
        raise busy(request.verb)

    def _completed(self, task: ServedTask, change: Change) -> Mapping[str, Any] | None:
        """The body of the change's event; None where nothing changes."""
        if not change.ids:
            return change.body
        refuse_archived(task)
        found = self._log.reads.trials(task.name, change.ids)
        refuse_unknown(task.name, change.ids, found)
        for trial in found:
            if task.corrections.hides(trial):
                raise Invalid(f"task {task.name!r} was rolled back to before trial {id_from_wire(trial['id'])}")
        if change.complete is None:
            return change.body
        return change.complete([task.corrections.present(trial) for trial in found])

    def restart(self, task: ServedTask) -> None:
        """Commits a restart of the outcome model, after a change of the robot. Called by learning."""
        with self._order:
            if task.archived or task.deleted or task.name not in self._tasks:
                return
            try:
                self._recover()
                with self.commits.timing():
                    event = self._log.append_event(task.name, "restart", {})
            except CrkrError as error:
                logger.warning("the restart of task %s's outcome model was not stored: %s", task.name, error.message)
                task.restarting = False
                return
            task.note_all([event])
            self._learning.submit(task, event)
            logger.warning("task %s: the robot has changed; the outcome model restarts at %d", task.name, event.seq)

    def _commit_change(self, task: ServedTask, change: Change, body: Mapping[str, Any] | None, request: Job) -> None:
        if task.archived and change.kind == "archive":  # a repeat, perhaps because the answer was lost
            self._await(task, (), task.seq, change, request)
            return
        if change.kind in _WHERE:
            self._refuse_in_use(task, change)
        else:
            refuse_archived(task)
        if body is None:
            self._await(task, (), task.seq, change, request)
            return
        with self.commits.timing():
            event = self._log.append_event(task.name, change.kind, body)
        name = task.name
        task.note_all([event])
        try:
            if change.kind in _WHERE:
                self._tasks.move(name, event)
        finally:  # it is stored
            self._await(task, event, event.seq, change, request)
        logger.info("%s of task %s at log position %d", change.kind, name, event.seq)

    def _refuse_in_use(self, task: ServedTask, change: Change) -> None:
        """Raise `Conflict` for a task with workers, or whose new name is taken."""
        alive = [worker["id"] for worker in self._workers.status(task.name) if worker["state"] == "alive"]
        if alive:
            raise Conflict(
                f"task {task.name!r} has {len(alive)} workers, {alive[0]!r} among them; end them before a {change.kind}"
            )
        if change.kind == "rename" and change.body["name"] in self._tasks.names():
            raise Conflict(f"there is a task {change.body['name']!r} already; choose another name")

    def _await(self, task: ServedTask, event: Event | tuple[()], seq: int, change: Change, request: Job) -> None:
        """Answer once the model includes the event, or the server stops."""

        def answer(result: Any, failure: Exception | None) -> None:
            if isinstance(failure, ShuttingDown) and change.kind in _KNOWN_BEFORE:
                failure = None  # it is stored; only the version lags behind
            found = {} if failure else change.answer(task, result)
            _settle(request, failure, {**found, "seq": seq, "model_version": task.model.version})

        done = None
        try:
            done = self._limits.hold(request, task, answer)
        finally:
            self._learning.submit(task, event, done)


def _tell(request: Request, error: BaseException) -> None:
    """Answer with the error, or not at all if that fails too: others are to be answered."""
    try:
        request.fail_unexpectedly(error)
    except BaseException as fault:
        FAULTS.note(fault)


def _settle(request: Job, failure: Exception | None, message: Mapping[str, Any]) -> None:
    """Answer with the failure if there is one, else with the message."""
    if failure is None:
        request.reply(message)
    else:
        request.fail_unexpectedly(failure)


def _refuse_deleted(task: ServedTask) -> None:
    if task.deleted:
        raise UnknownTask(f"task {task.name!r} was deleted meanwhile", details={"task": task.name})


def refuse_archived(task: ServedTask) -> None:
    """Raise `Invalid` for a task that is archived."""
    if task.archived:
        raise Invalid(f"task {task.name!r} is archived: it answers reads only", details={"task": task.name})
