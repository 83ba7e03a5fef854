"""Answers what only asks: info, tasks, status, model, samples, explain."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import Any, Final, final
from uuid import UUID

from crkr.learner.explain import explain
from crkr.protocol import (
    KINDS,
    MAX_MESSAGE_BYTES,
    MAX_STATES,
    MAX_TRIALS,
    PROTOCOL_VERSION,
    ShuttingDown,
    array_from_wire,
    id_from_wire,
)
from crkr.protocol.checks import integer, required
from crkr.server.lane import busy
from crkr.server.latency import Latencies
from crkr.server.learning import Learning
from crkr.server.log import LogReader
from crkr.server.request import Request
from crkr.server.tasks import ServedTask, Tasks, hyperparameters
from crkr.server.thread_faults import FAULTS
from crkr.server.workers import Workers

__all__ = ["Reader"]

_MOST_SAMPLES: Final = 10_000
_MOST_ASKED: Final = 64  # steps of learning that are waited for, after which it explains no sample
_PAGE_BYTES: Final = MAX_MESSAGE_BYTES // 2  # a page ends early rather than exceed what a message may be


@final
class Reader:
    """The work of the reading lanes.

    Args:
        queues: How full the server's queues are, for `status`.
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
    ) -> None:
        self._server_id, self._tasks, self._log, self._learning = server_id, tasks, log, learning
        self._workers, self._latencies, self._queues = workers, latencies, queues
        self._started, self._started_monotonic = time.time(), time.monotonic()
        self._version = version("crkr")  # of what runs, which is not what is installed after an upgrade
        self._verbs: Mapping[str, Callable[[Request], None]] = {
            "info": self._info,
            "tasks": self._list_tasks,
            "status": self._status,
            "model": self._model,
            "samples": self._samples,
            "explain": self._explain,
        }

    def work(self, requests: list[Request]) -> None:
        """Answers every one of them."""
        for request in requests:
            try:
                self._verbs[request.verb](request)
            except BaseException as error:  # answered; the others go on
                request.fail_unexpectedly(error)

    def _info(self, request: Request) -> None:
        request.message()
        threads = FAULTS.summary()
        request.reply(
            {
                "protocol": PROTOCOL_VERSION,
                "version": self._version,
                "server_id": self._server_id,
                "started": self._started,
                "tasks": [task.name for task in self._tasks.all()],
                "limits": {"states": MAX_STATES, "trials": MAX_TRIALS, "message_bytes": MAX_MESSAGE_BYTES},
                **({"threads": threads} if threads else {}),
            }
        )

    def _list_tasks(self, request: Request) -> None:
        request.message()
        request.reply({"tasks": [_summary(task) for task in self._tasks.all()]})

    def _status(self, request: Request) -> None:
        request.message()
        task = self._tasks.get(request.task)
        model = task.model
        queues = {**self._queues(), "learning": {"waiting": self._learning.backlog}}
        status: dict[str, Any] = {
            "task": task.name,
            "samples": {kind: task.samples[kind] for kind in KINDS},
            "eligible": task.eligible,
            "active": model.active,
            "seq": task.seq,
            "model_version": model.version,
            "hyperparameters": hyperparameters(model),
            "archived": task.archived,
            "workers": self._workers.status(task.name),
            "queues": queues,
            "latency_us": self._latencies.summary(),
            "uptime": time.monotonic() - self._started_monotonic,
        }
        if task.fault:
            status["fault"] = task.fault
        if task.damage:
            status["damage"] = task.damage
        if threads := FAULTS.summary():
            status["threads"] = threads
        request.reply(status)

    def _model(self, request: Request) -> None:
        known = request.message().get("known_version")
        model = self._tasks.get(request.task).model
        if known is not None and integer(known, "known_version") == model.version:
            request.reply({"unchanged": True, "version": model.version})
        else:
            request.reply(model.to_wire())

    def _samples(self, request: Request) -> None:
        message = request.message()
        task = self._tasks.get(request.task)
        after = integer(message.get("after", 0), "after")
        limit = integer(message.get("limit", 1000), "limit", low=1, high=_MOST_SAMPLES)
        samples, following = self._log.page(task.name, after, limit, _PAGE_BYTES)
        request.reply({"samples": samples, "next": following})

    def _explain(self, request: Request) -> None:
        message = request.message()
        task = self._tasks.get(request.task)
        state = array_from_wire(required(message, "state"), "state")
        sample = message.get("sample_id")
        if sample is None:
            request.reply(explain(task.model, state, None).to_wire())
            return
        sample_id = id_from_wire(sample, "sample_id")

        def answer(_result: Any, failure: Exception | None) -> None:
            if isinstance(failure, ShuttingDown):  # the learner may be busy still, on a thread that does not end
                request.fail(failure)
                return
            try:
                request.reply(task.learner.explain(state, sample_id).to_wire())
            except BaseException as error:
                request.fail_unexpectedly(error)

        if self._learning.asked >= _MOST_ASKED:
            raise busy(request.verb)
        request.held = True
        self._learning.submit(task, (), answer)  # where one sample stands only the learner itself knows


def _summary(task: ServedTask) -> dict[str, Any]:
    model = task.model
    return {
        "spec": task.spec.to_dict(),
        "samples": sum(task.samples.values()),
        "active": model.active,
        "model_version": model.version,
        "archived": task.archived,
    }
