"""The service: connects its parts, and shuts them down in an order that loses nothing."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, final
from uuid import uuid4

import zenoh

from crkr.learner import Learner, Model
from crkr.protocol import StorageError, UnknownTask, live_server_key, rpc_key, task_key
from crkr.protocol.keys import admin_key
from crkr.server.inspection.seal_check import SealCheck
from crkr.server.learning.acceleration import Acceleration
from crkr.server.learning.fit import DueFit, Fitting
from crkr.server.learning.notices import Notices
from crkr.server.learning.radii_cache import RadiiKeeper
from crkr.server.learning.restore import FEW, relearned
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import Event, TaskLog
from crkr.server.metrics.collector import MetricSources
from crkr.server.metrics.durations import Durations, Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import Lane
from crkr.server.queries.refusals import Refuser
from crkr.server.session import DEFAULT_LISTEN, endpoints, open_session
from crkr.server.session_renewal import SessionRenewal, cut_connections, is_broken, works_alone
from crkr.server.thread_faults import FAULTS, started
from crkr.server.verbs.predict import Predictor
from crkr.server.verbs.read import Reader, task_entry
from crkr.server.verbs.report import MOST_REPORTS, Writer
from crkr.server.workers import Workers

if TYPE_CHECKING:
    from crkr.server.membership import Membership

__all__ = ["DEFAULT_LISTEN", "Server", "ServerSettings"]

logger = logging.getLogger(__name__)

_QUEUE: Final = 256
# For a question about many states without a deadline, as from clients of version 0.1.
_PREDICT_PATIENCE_S: Final = 30.0
_CLOSES_S: Final = 1.0  # for a session to close, which may be broken
_UNDECLARED_S: Final = 0.2  # for its token to be undeclared
_BROKEN: Final = 75  # exit status without a session, so that a supervisor restarts the process
# For any other question without a deadline: less than Zenoh's default timeout of 10 s.
_PATIENCE_S: Final = 7.5
_LONGEST_S: Final = 4.0  # longest wait of a question for its turn; an ordinary call gives up after 5 s
_DRAIN_S: Final = 1.0  # for requests received before the stop


def _end(end: Callable[[], None], patience_s: float) -> None:
    """Close a session or undeclare a token. Never raises: what is broken panics or hangs."""

    def attempt() -> None:
        try:
            end()
        except BaseException as error:
            logger.debug("the session did not end cleanly: %r", error)

    ending = threading.Thread(target=attempt, name="session end", daemon=True)
    if started(ending):
        ending.join(patience_s)


def _give_up() -> None:
    """End the process. Acknowledged entries are in the log, for the next process to serve."""
    logger.critical(
        "Zenoh is broken in this process, and no client can be answered: the process ends with status %d and is to be "
        "started again",
        _BROKEN,
    )
    for handler in logging.getLogger().handlers:
        handler.flush()
    os._exit(_BROKEN)


@final
@dataclass(frozen=True, slots=True)
class ServerSettings:
    """How a server runs.

    Attributes:
        data: Data directory, created if missing, or a database's URL.
        listen: Zenoh endpoint; None: the configuration file's, or tcp/127.0.0.1:7447.
        zenoh_config: Zenoh configuration file (JSON5).
        peers: Endpoints of servers that share the log.
    """

    data: str
    listen: str | None = None
    zenoh_config: Path | None = None
    peers: Sequence[str] = ()


@final
class Server:
    """A running service; a context manager.

    Attributes:
        tasks: The tasks in service.
        sources: Where its metrics are read from.

    Raises:
        Unavailable: The endpoint cannot be listened on.
        Invalid: The endpoint or the Zenoh configuration is not understood.
        ShuttingDown: The servers that share the log are not reached.
    """

    def __init__(
        self, settings: ServerSettings, log: TaskLog, tasks: Iterable[ServedTask], membership: Membership | None = None
    ) -> None:
        self.tasks = Tasks(log.reads.moves())
        self._settings = settings
        self._log, self._membership = log, membership
        for task in tasks:
            self.tasks.add(task)
        try:
            self._session = self._open_session()
        except BaseException:
            self._log.close()
            raise
        self._latencies, self._workers = Latencies(), Workers()
        self._notices, self._radii = Notices(self._session), RadiiKeeper(self._log)
        self._acceleration = Acceleration()
        self._learning = Learning(self._learned, self._fit_when_due, self._restart_model, self._relearn)
        self._due: dict[str, DueFit] = {}
        self._lanes: list[Lane[Any]] = []
        self._refuser = Refuser()
        self._intakes: list[Intake] = []
        commits = self._wire()
        self.sources = MetricSources(
            log.sizes, self.tasks, self._latencies, self._workers, self._learning, commits, self._queues
        )
        long = {task.name: task.seq for task in self.tasks.all() if task.seq > FEW}  # others were read row by row
        self._renewal = SessionRenewal(self._renew_session, lambda: is_broken(self._session), _give_up, works_alone)
        self._seals = SealCheck(log.where, long, self._found_damage)
        self._token: zenoh.LivelinessToken | None = None
        self._start()

    def _wire(self) -> Durations:
        """Connect keys, lanes and work; returns the times of the commits."""
        server_id = self._log.log_id or uuid4()
        membership = self._membership
        predictor = Predictor(self.tasks, self._workers)
        reader = Reader(
            server_id,
            self.tasks,
            self._log.reads,
            self._learning,
            self._workers,
            self._latencies,
            self._queues,
            list if membership is None else membership.servers,
            (lambda _: {}) if membership is None else membership.described,
        )
        writer = self._writer = Writer(self._log, self.tasks, self._workers, self._learning)

        def lane(
            name: str, verbs: str, work: Any, most: int = 1, limit: int = _QUEUE, **how: Any
        ) -> dict[str, Lane[Any]]:
            made: Lane[Any] = Lane(name, dict.fromkeys(verbs.split(), limit), work, most, **how)
            self._lanes.append(made)
            return dict.fromkeys(verbs.split(), made)

        # A client's writes keep their order, and are stored even if it gave up: a late report is still data.
        fair: dict[str, Any] = {"fair": True, "patience_s": math.inf}
        changes = "recost remove amend undo configure rename archive delete"
        write = lane("write", "report", writer.store, MOST_REPORTS, 4096)
        orderly: dict[str, Any] = {"rests": True, "longest_s": _LONGEST_S, "keeps_order": True}
        write |= lane("changes", f"create_task {changes}", writer.change, **fair, **orderly)
        write |= lane("rollback", "rollback", writer.change, limit=16, **fair)
        quick: dict[str, Any] = {"fair": True, "patience_s": _PATIENCE_S, "longest_s": _LONGEST_S}
        brief = lane("brief", "info status spec model", reader.work, **quick)
        lists = lane("lists", "tasks", reader.work, rests=True, **quick)
        samples = lane("samples", "samples", reader.work, rests=True, **quick)
        explain = lane("explain", "explain", reader.work, rests=True, **quick)
        bulk = lane("bulk predict", "predict", predictor.work, fair=True, patience_s=_PREDICT_PATIENCE_S, joins=True)
        self._fitting = Fitting(self.tasks, self._learning, writer)
        refit = lane("refit", "refit", self._fitting.work, limit=16, **fair)
        self._refit_lane = refit["refit"]
        routes = {**write, **refit, **brief, **lists, **samples, **explain, **bulk}

        look_up = (lambda _: False) if membership is None else membership.look_up

        def intake(key: str, verbs: str, predict: Any = None, check_task: Any = None) -> None:
            served = {verb: routes[verb] for verb in verbs.split()}
            self._intakes.append(
                Intake(self._session, key, served, self._latencies, self._refuser, predict, check_task, look_up)
            )

        verbs = "predict report status spec model samples explain"
        intake(task_key("*", "*"), verbs, predictor.answer, self.tasks.look)
        intake(rpc_key("*"), "info tasks create_task")
        intake(admin_key("*", "*"), f"refit rollback {changes}", None, self.tasks.look_back)
        self._token_key = live_server_key(str(server_id))
        return writer.commits

    def _start(self) -> None:
        self._learning.start()
        for lane in self._lanes:
            lane.start()
        self._refuser.start()
        if self._membership is not None:
            self._membership.watch(self._session)
            try:
                self._membership.join(self.tasks)
            except BaseException:
                self.close()
                raise
            self._membership.start(self._writer.hand_over, self._radii.finish, task_entry, self._refuser)
        for intake in self._intakes:
            intake.start()
        self._workers.watch(self._session)
        # Last, because clients that see it may ask at once.
        self._token = self._session.liveliness().declare_token(self._token_key)
        self._seals.start()
        self._renewal.start()
        FAULTS.call_on_panic(self._renewal.note_panic)

    def _renew_session(self) -> None:
        """Close the session and open another; clients reconnect by themselves."""
        logger.error("Zenoh panics again and again: its session is opened again, and clients reconnect")
        _end(self._session.close, _CLOSES_S)  # one that panics or hangs has freed its port by then
        cut_connections(endpoints(self._settings.listen, self._settings.zenoh_config))
        self._session = self._open_session()
        self._notices.move(self._session)
        if self._membership is not None:
            self._membership.watch(self._session)
        for intake in self._intakes:
            intake.move(self._session)
        self._workers.watch(self._session)
        self._token = self._session.liveliness().declare_token(self._token_key)

    def _open_session(self) -> zenoh.Session:
        zenoh_id = None if self._membership is None else self._membership.zenoh_id
        return open_session(self._settings.listen, self._settings.zenoh_config, self._settings.peers, zenoh_id)

    def _fit_when_due(self, task: ServedTask) -> None:
        """Queue a due fit. Learning calls this after every step until the fit begins."""
        if self._learning.is_behind(task):
            return  # so that other tasks' fits do not wait for it
        due = self._due.get(task.name)
        if due is None or due.answered:
            self._due[task.name] = DueFit(task.name)
            refusal = self._refit_lane.offer(self._due[task.name])
            if refusal is not None:
                self._due[task.name].fail(refusal)

    def _restart_model(self, task: ServedTask) -> None:
        """Called by learning when outcomes show that a task's robot has changed."""
        self._writer.restart(task)

    def _relearn(self, task: ServedTask, event: Event) -> Learner:
        """Called by learning for a rollback."""
        return relearned(self._log.reads, task, event.body["to"])

    def _learned(self, task: ServedTask, before: Model, after: Model) -> None:
        """Publish and cache a new model. Learning calls this for each."""
        self._notices(task, before, after)
        self._radii.step(task)
        self._acceleration.step(task)

    def _found_damage(self, task: str, damage: str) -> None:
        with suppress(UnknownTask):  # renamed or deleted meanwhile
            self.tasks.look(task).damage = damage

    def _queues(self) -> dict[str, Any]:
        return {verb: depth for lane in self._lanes for verb, depth in lane.depths().items()}

    def close(self) -> None:
        """Commit and answer the received requests, then stop. New requests get `ShuttingDown`."""
        deadline = time.monotonic() + _DRAIN_S
        FAULTS.call_on_panic(None)
        if self._membership is not None:
            self._membership.stop(_DRAIN_S)
        self._renewal.stop(_DRAIN_S)
        if self._token is not None:
            _end(self._token.undeclare, _UNDECLARED_S)
        for intake in self._intakes:
            intake.stop()
        self._fitting.stop()
        self._acceleration.stop()
        self._seals.stop()
        for lane in self._lanes:
            lane.close(max(0.05, deadline - time.monotonic()))
        self._refuser.close(max(0.05, deadline - time.monotonic()))
        learned = self._learning.close(max(0.05, deadline - time.monotonic()))
        try:
            for task in self.tasks.all() if learned else ():  # no thread uses the learners now
                self._radii.finish(task)
        except StorageError as error:
            logger.warning("radii were not kept: %s", error.message)
        try:
            self._log.close()
        except StorageError as error:  # acknowledged entries are safe in the write-ahead log
            logger.warning("the task log was not closed cleanly: %s", error.message)
        _end(self._session.close, _CLOSES_S)
        for intake in self._intakes:
            intake.join(0.5)
        self._workers.join(0.5)
