"""What a client asks again after a lost answer is answered as the first time, and no answer is lost at the end."""

import math
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import msgpack
import pytest
import zenoh

from crkr.learner import Model
from crkr.protocol import Conflict, CrkrError, Invalid, ShuttingDown, TaskSpec, task_key
from crkr.server.learning.fit import Fitting
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.log import SqliteLog
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.request import Request
from crkr.server.session import open_session
from crkr.server.verbs.admin import Change, read_change
from crkr.server.verbs.read import Reader
from crkr.server.verbs.report import Writer
from crkr.server.workers import Workers

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]


class OwnJob:
    """A job that the test asks of the server, and keeps the answer of."""

    verb, task, size = "archive", "reach", 0
    client, received, deadline, left = b"", 0.0, math.inf, 0.0

    def __init__(self) -> None:
        self.answered = self.held = False
        self.message: dict[str, Any] = {}
        self.error: BaseException | None = None

    def reply(self, message: Mapping[str, Any]) -> None:
        self.answered, self.message = True, dict(message)

    def fail(self, error: CrkrError) -> None:
        self.fail_unexpectedly(error)

    def fail_unexpectedly(self, error: BaseException) -> None:
        self.answered, self.error = True, error


def ignore(_task: ServedTask, _before: Model | None = None, _after: Model | None = None) -> None:
    """Publishes no new models."""


@pytest.fixture
def learning() -> Learning:
    return Learning(ignore, ignore, lambda _: None)


@pytest.fixture
def task(reach: dict[str, Any]) -> ServedTask:
    return ServedTask(TaskSpec.from_dict(reach))


@pytest.fixture
def tasks(task: ServedTask) -> Tasks:
    made = Tasks()
    made.add(task)
    return made


@pytest.fixture
def log(tmp_path: Path, task: ServedTask) -> Iterator[SqliteLog]:
    made = SqliteLog(tmp_path)
    made.create(task.created)
    yield made
    made.close()


@pytest.fixture
def writer(log: SqliteLog, tasks: Tasks, learning: Learning) -> Writer:
    return Writer(log, tasks, Workers(), learning)


def test_archiving_again_is_answered_as_the_first_time(ask: Ask, make_trial: MakeTrial) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(1)]})
    first = ask("task/reach/admin/archive")
    assert (first["archived"], first["seq"]) == (True, 3)
    assert ask("task/reach/admin/archive") == first
    assert ask("task/reach/rpc/status")["seq"] == 3


def test_requests_that_wait_at_the_end_are_answered_by_what_was_stored(
    writer: Writer,
    learning: Learning,
    task: ServedTask,
    make_trial: MakeTrial,
    free_port: int,
    plain: Callable[[str], zenoh.Session],
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(task_key("*", "*"), zenoh.handlers.FifoChannel(8), complete=True)
        payload = msgpack.packb({"trials": [make_trial(1)], "wait": True})
        replies = plain(endpoint).get(
            task_key("reach", "report"), zenoh.handlers.FifoChannel(1), payload=payload, timeout=10.0
        )
        writer.store([Request(queries.recv(), Latencies())])
        removal, archiving = OwnJob(), OwnJob()
        writer.commit(task, read_change("remove", {"ids": [UUID(int=2).bytes]}, task), removal)
        writer.commit(task, read_change("archive", {}, task), archiving)
        assert not removal.answered
        assert not archiving.answered
        learning.close(0.05)  # it never began to learn
        reply = replies.recv()
        assert reply.ok is not None
        assert msgpack.unpackb(reply.ok.payload.to_bytes()) == {
            "accepted": 1,
            "duplicates": 0,
            "seqs": [2],
            "model_version": 1,
        }
    assert archiving.message == {"archived": True, "seq": 4, "model_version": 1}
    assert isinstance(removal.error, ShuttingDown)  # how many it removed is known to the successor only


def test_what_somebody_waits_for_is_still_learned_at_the_end(
    writer: Writer, learning: Learning, task: ServedTask
) -> None:
    working, go_on = threading.Event(), threading.Event()

    def hold(_result: Any, _failure: Exception | None) -> None:
        working.set()
        go_on.wait(10)

    learning.start()
    learning.submit(task, (), hold)
    assert working.wait(10)
    configuring = OwnJob()
    writer.commit(task, read_change("configure", {"changes": {"budget": 5}}, task), configuring)
    closing = threading.Thread(target=learning.close, args=(10.0,))
    closing.start()
    go_on.set()
    closing.join(10)
    assert configuring.message["spec"]["budget"] == 5
    assert configuring.message["model_version"] == configuring.message["seq"] == 2


def test_requests_after_the_end_of_learning_are_refused(learning: Learning, task: ServedTask) -> None:
    learning.start()
    assert learning.close(5.0)
    failures: list[Exception | None] = []
    learning.submit(task, (), lambda _, failure: failures.append(failure))
    assert [type(failure) for failure in failures] == [ShuttingDown]


def test_more_than_learning_can_answer_is_refused_as_busy(
    writer: Writer,
    log: SqliteLog,
    tasks: Tasks,
    learning: Learning,
    task: ServedTask,
    make_trial: MakeTrial,
    free_port: int,
    plain: Callable[[str], zenoh.Session],
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    reader = Reader(uuid4(), tasks, log.reads, learning, Workers(), Latencies(), dict, list, lambda _: {})
    trial = make_trial(1)
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable("crkr/@v1/task/reach/**", zenoh.handlers.FifoChannel(8), complete=True)
        asking = plain(endpoint)

        def ask(work: Callable[[list[Request]], None], verb: str, message: dict[str, Any]) -> Callable[[], str]:
            """Has it worked on; what is returned waits for the answer's code."""
            replies = asking.get(
                f"crkr/@v1/task/reach/{verb}",
                zenoh.handlers.FifoChannel(1),
                payload=msgpack.packb(message),
                timeout=10.0,
            )
            work([Request(queries.recv(), Latencies())])

            def code() -> str:
                reply = replies.recv()
                return msgpack.unpackb(reply.err.payload.to_bytes())["code"] if reply.err is not None else "OK"

            return code

        questions: list[tuple[Callable[[list[Request]], None], str, dict[str, Any]]] = [
            (writer.store, "rpc/report", {"trials": [trial], "wait": True}),
            (writer.change, "admin/configure", {"changes": {"budget": 5}}),
            (reader.work, "rpc/explain", {"state": [0.5, 0.0], "sample_id": trial["id"]}),
        ]
        taken = [ask(*question) for question in questions]
        taken.append(ask(*questions[0]))  # a duplicate
        assert learning.asked == 4
        while learning.asked < 1024:
            learning.submit(task, (), lambda *_: None)
        assert [ask(*question)() for question in questions] == ["BUSY"] * 3
        assert ask(writer.store, "rpc/report", {"trials": [make_trial(2)]})() == "OK"  # nobody waits for learning here
        learning.start()
        assert [code() for code in taken] == ["OK"] * 4
        assert [ask(*question)() for question in questions] == ["OK"] * 3
        assert learning.close(5.0)
        assert learning.asked == 0


def test_a_fit_of_settings_that_were_changed_meanwhile_is_not_stored(
    writer: Writer, log: SqliteLog, learning: Learning, task: ServedTask
) -> None:
    fitted = {"lengthscales": [0.3, 0.3], "signal_variance": 2.0, "evidence_before": 0.0, "evidence_after": 1.0}
    fit, before = Change("fit", fitted, lambda _task, _applied: {"accepted": True}), task.configured
    writer.commit(task, read_change("configure", {"changes": {"budget": 5}}, task), OwnJob())
    with pytest.raises(Conflict, match="configured again"):
        writer.commit(task, fit, OwnJob(), before)
    assert task.seq == 2
    job = OwnJob()
    writer.commit(task, fit, job, task.configured)
    learning.start()
    writer.commit(task, read_change("archive", {}, task), OwnJob())
    assert learning.close(10.0)
    assert (job.message["accepted"], job.message["seq"]) == (True, 3)
    assert task.model.parameters.kernel.lengthscales.tolist() == [0.3, 0.3]


def test_an_archived_task_is_refused_before_anything_is_fitted(
    tasks: Tasks, task: ServedTask, writer: Writer, learning: Learning
) -> None:
    writer.commit(task, read_change("archive", {}, task), OwnJob())
    with pytest.raises(Invalid, match="archived"):  # and not a wait for learning, which never began
        Fitting(tasks, learning, writer).work([OwnJob()])
    assert learning.asked == 1
    learning.close(0.05)
