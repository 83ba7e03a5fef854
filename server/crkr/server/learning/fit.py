"""Fits the kernel in a separate process, so that predictions do not wait for the seconds it takes."""

from __future__ import annotations

import logging
import math
import multiprocessing
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final, final

from crkr.learner import FitProblem, FitResult, check_fit, fit
from crkr.protocol import Busy, CrkrError, Internal, ShuttingDown, Unsupported
from crkr.server.installed_code import InstalledCode
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.learning.thread import Learning
from crkr.server.queries.queue import busy, shutting_down
from crkr.server.queries.request import Job, Request
from crkr.server.verbs.admin import Change
from crkr.server.verbs.report import Writer, refuse_archived

__all__ = ["DueFit", "Fitting"]

logger = logging.getLogger(__name__)

_PATIENCE_S: Final = 120.0
_POLL_S: Final = 0.2
_RETRY_MS: Final = 1000


@final
class DueFit:
    """A fit that is due by `refit_every`, without a request. Its result goes to the process's log."""

    verb = "refit"
    size = 0
    client = b""
    received = 0.0
    deadline = math.inf
    left = 0.0

    def __init__(self, task: str) -> None:
        self.task = task
        self.answered = self.held = False

    def reply(self, message: Mapping[str, Any]) -> None:
        """Log the result."""
        self.answered = True
        logger.info("fit of task %s: %s", self.task, "accepted" if message["accepted"] else "nothing better found")

    def fail(self, error: CrkrError) -> None:
        """Log the failure."""
        self.answered = True
        logger.warning("fit of task %s failed: %s", self.task, error.message)

    def fail_unexpectedly(self, error: BaseException) -> None:
        """Log the failure, with the traceback of a defect."""
        if isinstance(error, CrkrError):
            self.fail(error)
            return
        self.answered = True
        logger.error("fit of task %s failed", self.task, exc_info=error)


@final
class Fitting:
    """The work of the refit lane; its process starts at the first fit."""

    def __init__(self, tasks: Tasks, learning: Learning, writer: Writer) -> None:
        self._tasks, self._learning, self._writer = tasks, learning, writer
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None
        self._stopped = threading.Event()
        self._code = InstalledCode()

    def work(self, jobs: list[Job]) -> None:
        """Fit, store the result if it is better, and answer."""
        for job in jobs:
            task = self._tasks.get(job.task)
            if isinstance(job, Request):
                job.message()
            refuse_archived(task)
            configured = task.configured
            if self._learning.is_behind(task):
                raise busy(job.verb)
            result = self._fit(self._problem(task))
            found = _fields(result)
            if not result.accepted:
                job.reply({**found, "seq": task.seq, "model_version": task.model.version})
                continue
            check_fit(task.created, result.lengthscales, result.signal_variance)  # before it is logged
            body = {"lengthscales": result.lengthscales.tolist(), "signal_variance": result.signal_variance}
            evidence = {"evidence_before": result.before, "evidence_after": result.after}
            self._writer.commit(task, Change("fit", {**body, **evidence}, _answer(found)), job, configured)

    def stop(self) -> None:
        """Abort the current fit and end the process."""
        self._stopped.set()
        process = self._process  # the lane's thread may discard it meanwhile
        if process is not None:
            process.kill()  # it may be stopped
            process.join(0.5)

    def _problem(self, task: ServedTask) -> FitProblem:
        """The fit problem; only the learning thread may ask the learner."""
        future: Future[FitProblem] = Future()

        def begin(_result: Any, failure: Exception | None) -> None:
            try:
                if isinstance(failure, ShuttingDown):
                    raise failure
                future.set_result(task.learner.begin_fit())
            except Exception as error:
                future.set_exception(error)

        self._learning.submit(task, (), begin)
        return future.result(_PATIENCE_S)

    def _fit(self, problem: FitProblem) -> FitResult:
        try:
            pipe = self._start()
            pipe.send(problem)
            for _ in range(int(_PATIENCE_S / _POLL_S)):
                if self._stopped.is_set():
                    raise shutting_down()
                if pipe.poll(_POLL_S):
                    answer = pipe.recv()
                    if isinstance(answer, FitResult):
                        return answer
                    raise Internal(f"the fit failed: {answer}")
        except (EOFError, OSError) as error:
            self._discard()
            if self._stopped.is_set():
                raise shutting_down() from error
            raise Internal("the process that fits died; ask again for a new one") from error
        self._discard()
        raise Internal(f"the fit took more than {_PATIENCE_S} s and was given up")

    def _start(self) -> Connection:
        if self._pipe is None or self._process is None or not self._process.is_alive():
            if self._code.is_replaced:
                raise Unsupported(
                    "crkr was upgraded or removed while this server runs, and a fit takes a new process: restart the "
                    "server, and ask again"
                )
            context = multiprocessing.get_context("spawn")  # a fork would break Zenoh's threads
            try:
                self._pipe, theirs = context.Pipe()
                with theirs:  # closed here, so that each side notices the other's death
                    process = context.Process(target=_serve, args=(theirs,), name="fit", daemon=True)
                    process.start()
            except OSError as error:
                raise Busy(
                    f"the system starts no process for the fit ({error.strerror}): raise the server's limit of "
                    "processes and files, or ask again later",
                    retry_ms=_RETRY_MS,
                ) from error
            self._process = process
        return self._pipe

    def _discard(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join(1.0)
        self._process = self._pipe = None


def _serve(pipe: Connection) -> None:
    """The process: fit each problem received, until the server is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this process
    with suppress(EOFError, OSError):
        while True:
            problem = pipe.recv()
            try:
                answer: FitResult | str = fit(problem)
            except Exception as error:
                answer = f"{type(error).__name__}: {error}"
            pipe.send(answer)


def _answer(found: dict[str, Any]) -> Callable[[ServedTask, Any], dict[str, Any]]:
    return lambda _task, _applied: found


def _fields(result: FitResult) -> dict[str, Any]:
    return {
        "accepted": result.accepted,
        "lengthscales": result.lengthscales,
        "signal_variance": result.signal_variance,
        "evidence_before": result.before,
        "evidence_after": result.after,
    }
