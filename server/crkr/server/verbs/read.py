"""The reading verbs: info, tasks, spec, status, model, samples, explain. No answer grows with use."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from itertools import islice
from operator import itemgetter
from typing import Any, Final, final
from uuid import UUID

from crkr.learner.explanation import explain
from crkr.protocol import (
    KINDS,
    MAX_MESSAGE_BYTES,
    MAX_STATES,
    MAX_TRIALS,
    PROTOCOL_VERSION,
    Invalid,
    ShuttingDown,
    array_from_wire,
    id_from_wire,
    most_active,
    pack_around,
    trial_ids,
)
from crkr.protocol.checks import flag, integer, required
from crkr.server.learning.served_task import ServedTask, hyperparameters
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import LogReader
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.queue import busy
from crkr.server.queries.request import Request
from crkr.server.thread_faults import FAULTS
from crkr.server.verbs.admin import refuse_unknown
from crkr.server.workers import Workers

__all__ = ["Reader", "task_entry"]

_MOST: Final = 10_000  # samples or tasks in a page
_MOST_ASKED: Final = 64  # waiting steps of a task beyond which `explain` is refused
_MOST_WORKERS: Final = 256  # in a status
_LONGEST: Final = 4096  # characters of a fault
_REST_BYTES: Final = 4096  # of a list of tasks, without its entries
_MOST_FAULTS: Final = 20  # in `info`
_PAGE_BYTES: Final = MAX_MESSAGE_BYTES // 2  # a page ends early to fit into a message


@final
class Reader:
    """The work of the reading lanes.

    Args:
        queues: Verb -> {waiting, limit}, for `status`.
        servers: Zenoh ids of the servers that share the log.
        described: Names of tasks that others serve -> their entries in `tasks`.
    """

    def __init__(
        self,
        server_id: UUID,
        tasks: Tasks,
        log: LogReader,
        learning: Learning,
        workers: Workers,
        latencies: Latencies,
        queues: Callable[[], Mapping[str, Any]],
        servers: Callable[[], Sequence[str]],
        described: Callable[[Sequence[str]], Mapping[str, bytes]],
    ) -> None:
        self._server_id, self._tasks, self._log, self._learning = server_id, tasks, log, learning
        self._workers, self._latencies, self._queues = workers, latencies, queues
        self._servers, self._described = servers, described
        self._started, self._started_monotonic = time.time(), time.monotonic()
        self._version = version("crkr")  # version of the running code, which an upgrade does not change
        self._verbs: Mapping[str, Callable[[Request], None]] = {
            "info": self._info,
            "tasks": self._list_tasks,
            "spec": self._spec,
            "status": self._status,
            "model": self._model,
            "samples": self._samples,
            "explain": self._explain,
        }

    def work(self, requests: list[Request]) -> None:
        """Answer all requests."""
        for request in requests:
            try:
                self._verbs[request.verb](request)
            except BaseException as error:  # the other requests go on
                request.fail_unexpectedly(error)

    def _info(self, request: Request) -> None:
        tasks, following = self._tasks.page(*_span(request.message(), low=0))
        threads = FAULTS.summary()
        servers = self._servers()
        request.reply(
            {
                "protocol": PROTOCOL_VERSION,
                "version": self._version,
                "server_id": self._server_id,
                "started": self._started,
                "tasks": tasks,
                "task_count": len(self._tasks),
                "next": following,
                "faulty": {
                    name: fault[:_LONGEST] for name, fault in islice(self._tasks.faults().items(), _MOST_FAULTS)
                },
                "limits": {"states": MAX_STATES, "trials": MAX_TRIALS, "message_bytes": MAX_MESSAGE_BYTES},
                **({"threads": threads} if threads else {}),
                **({"servers": servers} if servers else {}),
            }
        )

    def _list_tasks(self, request: Request) -> None:
        message = request.message()
        if "after" in message or "limit" in message:
            names, following = self._tasks.page(*_span(message))
            page, whole = self._entries(names, _PAGE_BYTES)
            if not whole:
                following = integer(message.get("after", 0), "after") + len(page)
        else:  # clients of version 0.1
            following, (page, whole) = None, self._entries(self._tasks.names(), MAX_MESSAGE_BYTES - _REST_BYTES)
            if not whole:
                raise Invalid(
                    f"{len(self._tasks)} tasks are too many for one message, which holds {len(page)} of these; ask for "
                    "one by its `spec`, or for pages by `limit` and `after` (the last page's `next`), as a newer "
                    "client does",
                    details={"tasks": len(self._tasks), "most": len(page)},
                )
        request.reply_packed(pack_around({"next": following}, "tasks", page))

    def _entries(self, names: Sequence[str], most_bytes: int) -> tuple[list[bytes], bool]:
        """Encoded entries of the tasks that fit, at least one, and whether all did."""
        elsewhere = [name for name in names if self._tasks.is_elsewhere(name)]
        described = self._described(elsewhere) if elsewhere else {}
        entries: list[bytes] = []
        size = 0
        for name in names:
            entry = described.get(name)
            if entry is None:  # served here, or not described by its server yet
                entry = task_entry(self._tasks.look(name))
            size += len(entry)
            if entries and size > most_bytes:
                return entries, False
            entries.append(entry)
        return entries, True

    def _spec(self, request: Request) -> None:
        request.message()
        task = self._tasks.look(request.task)
        about = {"log_id": task.log_id, "archived": task.archived, "model_version": task.model.version}
        request.reply_packed(pack_around(about, "spec", task.packed_spec()))

    def _status(self, request: Request) -> None:
        brief = flag(request.message().get("brief", False), "brief")
        task = self._tasks.look(request.task)
        model = task.model
        status: dict[str, Any] = {
            "task": task.name,
            "samples": {kind: task.samples[kind] for kind in KINDS},
            "eligible": task.eligible,
            "active": model.active,
            "seq": task.seq,
            "model_version": model.version,
            "archived": task.archived,
        }
        if brief:
            request.reply(status)
            return
        queues = {**self._queues(), "learning": {"waiting": self._learning.backlog}}
        workers, more_workers = _most_present(self._workers.status(task.name))
        status |= {
            "hyperparameters": hyperparameters(model),
            "workers": workers,
            "queues": queues,
            "latency_us": self._latencies.summary(),
            "uptime": time.monotonic() - self._started_monotonic,
            "time": time.time(),
        }
        if more_workers:
            status["more_workers"] = more_workers
        for name, trouble in (("fault", task.fault), ("damage", task.damage)):
            if trouble:
                status[name] = trouble[:_LONGEST]
        if task.drift is not None:
            own = task.drift
            status["drift"] = {"restarts": own.restarts, "last_seq": own.last_seq, "score": own.score}
        status["success"] = task.history.trend()._asdict()
        if advice := task.advice():
            status["advice"] = [one._asdict() for one in advice]
        if threads := FAULTS.summary():
            status["threads"] = threads
        request.reply(status)

    def _model(self, request: Request) -> None:
        known = request.message().get("known_version")
        model = self._tasks.get(request.task).model
        if known is not None and integer(known, "known_version") == model.version:
            request.reply({"unchanged": True, "version": model.version})
            return
        most = most_active(*map(len, (model.parameters.kernel.centre, model.parameters.scales)))
        if model.active > most:  # an earlier version allowed it
            raise Invalid(
                f"the model of task {request.task!r} has {model.active} active samples, and a message holds {most}; "
                "ask for predictions instead, or lower its budget by `crkr configure`",
                details={"active": model.active, "most": most},
            )
        request.reply(model.to_wire())

    def _samples(self, request: Request) -> None:
        message = request.message()
        task = self._tasks.look(request.task)
        after = integer(message.get("after", 0), "after")
        limit = integer(message.get("limit", 1000), "limit", low=1, high=_MOST)
        if "id" in message:
            samples, following = self._named(task, message["id"]), None
        elif "last" in message or "before" in message:
            before = integer(message["before"], "before") if "before" in message else None
            limit = integer(message.get("last", limit), "last", low=1, high=_MOST)
            samples, following = self._log.page_before(task.name, before, limit, _PAGE_BYTES)
        else:
            samples, following = self._log.page(task.name, after, limit, _PAGE_BYTES)
        answer: dict[str, Any] = {
            "samples": [task.corrections.present(sample) for sample in samples],
            "next": following,
        }
        if "last" in message or "before" in message:
            answer["backwards"] = True
        request.reply(answer)

    def _named(self, task: ServedTask, given: object) -> list[dict[str, Any]]:
        ids = trial_ids(given if isinstance(given, list) else [given])
        found = self._log.trials(task.name, ids)
        refuse_unknown(task.name, ids, found)
        return found

    def _explain(self, request: Request) -> None:
        message = request.message()
        task = self._tasks.get(request.task)
        state = array_from_wire(required(message, "state"), "state")
        sample = message.get("sample_id")
        if sample is None:
            request.reply(explain(task.model, task.history, state).to_wire())
            return
        sample_id = id_from_wire(sample, "sample_id")

        def answer(_result: Any, failure: Exception | None) -> None:
            if isinstance(failure, ShuttingDown):  # the learner may still be busy
                request.fail(failure)
                return
            try:
                request.reply(task.learner.explain(state, sample_id).to_wire())
            except BaseException as error:
                request.fail_unexpectedly(error)

        if self._learning.is_behind(task) or self._learning.waiting(task)[1] >= _MOST_ASKED:
            raise busy(request.verb)
        request.held = True
        self._learning.submit(task, (), answer)  # only the learner knows a sample's status


def _span(message: Mapping[str, Any], low: int = 1) -> tuple[int, int]:
    """The requested page of tasks: how many to skip, in order of creation, and how many to list."""
    return integer(message.get("after", 0), "after"), integer(message.get("limit", 1000), "limit", low=low, high=_MOST)


def task_entry(task: ServedTask) -> bytes:
    """A task as `tasks` lists it, encoded."""
    model = task.model
    about = {
        **({"fault": task.fault[:_LONGEST]} if task.fault else {}),
        "samples": sum(task.samples.values()),
        "active": model.active,
        "model_version": model.version,
        "archived": task.archived,
    }
    return pack_around(about, "spec", task.packed_spec())


def _most_present(workers: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], int]:
    """The workers to list, living and recently seen ones first, and the number of the others."""
    if len(workers) <= _MOST_WORKERS:
        return workers, 0
    ranked = sorted(workers, key=lambda worker: (worker["state"] != "alive", worker["last_seen_s"]))
    return sorted(ranked[:_MOST_WORKERS], key=itemgetter("id")), len(workers) - _MOST_WORKERS
