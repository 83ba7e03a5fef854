"""The worker processes of a supervisor: started, listened to, and ended."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Final, final

from crkr.sim_worker.supervisor.child_process import MessagePipe, PipeClosed, ctrl_c_blocked, descendants_ended

__all__ = ["WorkerProcess", "WorkerProcesses"]

FINISH_S: Final = 2.0
"""Time for a stopped worker to finish its trial [s]."""
TERMINATE_S: Final = 1.0
"""Time after which a terminated worker is killed [s]."""
MOST_EVENTS: Final = 100


@final
@dataclass(slots=True, eq=False)
class WorkerProcess:
    """One worker as its supervisor sees it.

    Attributes:
        name: For people.
        process: The process.
        pipe: Our end of the pipe to it.
        ended: A file that is readable once it has ended, even if a process that it started holds its files.
        tickets: Trials that it may still start or has under way.
        reason: Why it ended, if it said so.
        silent_s: How long it had made no progress when it was killed for that, or None [s].
    """

    name: str
    process: SpawnProcess
    pipe: MessagePipe
    ended: int
    tickets: int = 0
    reason: str | None = None
    silent_s: float | None = None

    def send(self, order: str, **fields: Any) -> None:
        """Sends an order; a failure is ignored, since the end of the process is noticed anyway."""
        try:
            self.pipe.send({"order": order, **fields})
        except PipeClosed:
            return

    def close(self) -> None:
        """Closes our ends; it has ended."""
        self.pipe.close()
        if self.ended != self.process.sentinel:
            os.close(self.ended)

    def kill(self, silent_s: float) -> None:
        """Kills it after `silent_s` without progress; its end is noticed like any other."""
        self.silent_s = silent_s
        self.process.kill()

    def ending(self) -> str:
        """How it ended, in words."""
        code = self.process.exitcode
        if self.silent_s is not None:
            return f"made no progress for {self.silent_s:.0f} s and was killed"
        if self.reason is not None:
            return f"ended: {self.reason}"
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with status {code}"


@final
class WorkerProcesses:
    """Starts processes by the spawn method and receives their events; ends them all when left, and what they started.

    The terminal's Ctrl-C, which goes to the whole foreground group, does not reach them: the supervisor ends them.
    """

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._workers: list[WorkerProcess] = []
        self._descendants = ExitStack()

    def __enter__(self) -> WorkerProcesses:
        self._descendants.enter_context(descendants_ended())
        return self

    def __exit__(self, *exception: object) -> None:
        with self._descendants:
            self.stop()

    def start(self, name: str, body: Callable[[Any, Connection], None], settings: object) -> WorkerProcess:
        """Starts `body(settings, connection)` in a new process."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=body, args=(settings, theirs), name=name)
        with ctrl_c_blocked():
            process.start()
        theirs.close()  # so that the pipe ends with the process
        ended = os.pidfd_open(process.pid or 0) if hasattr(os, "pidfd_open") else process.sentinel
        worker = WorkerProcess(name, process, MessagePipe(ours), ended)
        self._workers.append(worker)
        return worker

    def events(self, timeout_s: float) -> Iterator[tuple[WorkerProcess, dict[str, Any] | None]]:
        """Events within `timeout_s`; None for the end of a worker, after its last event."""
        ready = wait([item for worker in self._workers for item in _handles(worker)], timeout_s)
        for worker in list(self._workers):
            if any(handle in ready for handle in _handles(worker)):
                yield from self._read(worker)

    def _read(self, worker: WorkerProcess) -> Iterator[tuple[WorkerProcess, dict[str, Any] | None]]:
        try:
            for _ in range(MOST_EVENTS):  # others take turns, and limits of time are looked at
                if (event := worker.pipe.receive(0.0)) is None:
                    break
                yield worker, event
            else:
                return
        except PipeClosed:
            wait([worker.ended], TERMINATE_S)  # the pipe ends a moment before the process does
            if worker.process.exitcode is None:
                worker.reason = worker.reason or "its pipe to this process broke"
                worker.process.kill()
                worker.process.join()
        if worker.process.exitcode is not None:
            self._workers.remove(worker)
            worker.close()
            yield worker, None

    def stop(self) -> list[tuple[WorkerProcess, dict[str, Any]]]:
        """Ends all workers within 4 s: by an order, then by SIGTERM, then by SIGKILL. Returns their last events."""
        workers = list(self._workers)
        for worker in workers:
            worker.send("stop")
        self._join(FINISH_S)
        for worker in self._workers:
            worker.process.terminate()
        self._join(TERMINATE_S)
        for worker in self._workers:
            worker.process.kill()
        self._join(TERMINATE_S)
        self._workers.clear()
        last = [(worker, event) for worker in workers for event in _rest(worker)]
        for worker in workers:
            worker.close()
        return last

    def _join(self, patience_s: float) -> None:
        deadline = time.monotonic() + patience_s
        for worker in self._workers:
            wait([worker.ended], max(0.0, deadline - time.monotonic()))
        self._workers = [worker for worker in self._workers if worker.process.exitcode is None]


def _rest(worker: WorkerProcess) -> Iterator[dict[str, Any]]:
    """Events left in the pipe of a worker that has ended."""
    try:
        for _ in range(MOST_EVENTS):
            if (event := worker.pipe.receive(0.0)) is None:
                return
            yield event
    except PipeClosed:
        return


def _handles(worker: WorkerProcess) -> tuple[Any, Any]:
    return worker.pipe.connection, worker.ended
