"""Reports that outlive the network: kept in a file first, sent when the server answers, and stored there once.

A trial's id makes a repeated report harmless, so what was sent and not acknowledged is sent again: after a lost link, a
restart of the server, or one of the robot.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, final
from uuid import UUID

from crkr.client.forks import check_not_forked
from crkr.client.outbox_file import OutboxFile, Refused
from crkr.client.rpc import Rpc
from crkr.protocol import Conflict, CrkrError, Invalid, Prediction, TaskSpec, Unavailable, make_trials, task_key

__all__ = ["Outbox"]

_logger = logging.getLogger(__name__)
_TOGETHER: Final = 256  # trials in a message
_ATTEMPT_S: Final = 3.0  # to send one
_FIRST_PAUSE_S: Final = 0.1  # after a message that was not answered
_LONGEST_PAUSE_S: Final = 2.0
_JOIN_S: Final = 0.5


@final
class Outbox:
    """Takes reports as `Task.report` does and delivers them in the background, in order; many threads may share it.

    Attributes:
        path: The file.
        spec: The task's specification, as it was when the file was made.
    """

    def __init__(self, rpc: Rpc, task: str, path: Path, specification: Callable[[], TaskSpec]) -> None:
        """Opens the file and goes on with what is in it; `Task.outbox` makes one.

        Args:
            rpc: What sends.
            task: The task's name.
            path: The file, made where it is not there.
            specification: Asks for the task's; called for a new file only, which keeps it.

        Raises:
            StorageError: The file cannot be opened, is none of these, or another process has it open.
            Conflict: It belongs to another task.
            CrkrError: Whatever `specification` raises.
        """
        self.path: Final = path
        self._rpc, self._key = rpc, task_key(task, "report")
        self._file = OutboxFile(path, task)
        try:
            self.spec: Final = self._file.spec or self._file.describe(specification())
            self._pending = self._file.pending()
        except BaseException:
            self._file.close()
            raise
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._fault: CrkrError | None = None
        self._thread = threading.Thread(target=self._deliver, name=f"crkr-outbox-{task}", daemon=True)
        self._thread.start()

    @property
    def pending(self) -> int:
        """How many trials are still to be delivered."""
        return self._pending

    @property
    def fault(self) -> CrkrError | None:
        """Why the last message was not delivered; None: it was."""
        return self._fault

    def refused(self) -> list[Refused]:
        """Trials that the server does not take (`Invalid`, `Conflict`); they stay in the file for you to look at."""
        return self._file.refused()

    def discard(self, refused: Sequence[Refused]) -> None:
        """Forgets refused trials for good."""
        self._file.delivered([one.number for one in refused])

    def report(
        self,
        answer: Prediction | None = None,
        *,
        state: object = None,
        goal: object = None,
        cost: object,
        success: object,
        kind: str = "trial",
        id: UUID | bytes | Sequence[UUID | bytes] | None = None,  # noqa: A002 - the protocol's word
        outcome: object = None,
        worker: str | None = None,
        model_version: int | None = None,
        info: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    ) -> tuple[UUID, ...]:
        """Keeps what one trial or a batch cost; arguments as for `Task.report`.

        Returns:
            The ids, once the trials are in the file and on the disk. The server has them when `pending` says so.

        Raises:
            Invalid: A value of the wrong shape or out of range; nothing is kept.
            StorageError: The file cannot be written; nothing is kept.
            Unavailable: The outbox was closed.
        """
        check_not_forked()
        trials = make_trials(
            self.spec,
            answer,
            state=state,
            goal=goal,
            cost=cost,
            success=success,
            kind=kind,
            id=id,
            outcome=outcome,
            worker=worker,
            model_version=model_version,
            info=info,
        )
        with self._changed:
            if self._closing.is_set():
                raise Unavailable(f"the outbox {self.path} is closed")
            self._file.add(trials)
            self._pending += len(trials)
            self._changed.notify_all()
        return tuple(trial.id for trial in trials)

    def flush(self, timeout_s: float) -> None:
        """Waits until all is delivered or refused.

        Raises:
            Unavailable: Some is not by the deadline, or the outbox was closed; it stays in the file.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._pending or self._closing.is_set(), timeout_s)
            left = self._pending
        if left:
            why = f": {self._fault.message}" if self._fault is not None else ""
            raise Unavailable(f"{left} trials are still in the outbox {self.path}{why}", details={"pending": left})

    def close(self) -> None:
        """Ends delivering and frees the file, which keeps what is left for the next time; idempotent."""
        with self._changed:
            if self._closing.is_set():
                return
            self._closing.set()
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)  # what is under way is sent again the next time, if need be
        self._file.close()

    def __enter__(self) -> Outbox:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _deliver(self) -> None:
        pause = 0.0
        while not self._closing.wait(pause):
            with self._changed:
                self._changed.wait_for(lambda: self._pending or self._closing.is_set())
            if self._closing.is_set():
                return
            try:
                self._send(self._file.next(_TOGETHER))
            except CrkrError as error:
                if self._fault is None:
                    _logger.info("%d trials wait in %s: %s", self._pending, self.path, error.message)
                self._fault = error
                pause = min(max(2.0 * pause, _FIRST_PAUSE_S), _LONGEST_PAUSE_S)
            else:
                pause = 0.0

    def _send(self, rows: list[tuple[int, dict[str, Any]]]) -> None:
        """Sends trials together; where one of them is refused, by halves, until it is found."""
        try:
            self._rpc.call(self._key, {"trials": [trial for _, trial in rows]}, _ATTEMPT_S)
        except (Invalid, Conflict) as error:
            if len(rows) > 1:
                middle = len(rows) // 2
                self._send(rows[:middle])
                self._send(rows[middle:])
                return
            [(number, trial)] = rows
            _logger.warning("trial %s was refused: %s", UUID(bytes=trial["id"]), error.message)
            self._file.refuse(number, f"{error.code}: {error.message}")
        else:
            self._file.delivered([number for number, _ in rows])
        with self._changed:
            self._fault = None
            self._pending -= len(rows)
            self._changed.notify_all()
