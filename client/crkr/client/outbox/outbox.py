"""Reports that survive a lost network: kept in a file, sent when the server answers, and stored there once.

A trial's id makes a repeated report harmless, so unacknowledged trials are sent again after a lost link or a restart of
the server or of the robot.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, final
from uuid import UUID

from crkr.client.checks import answer_to, check_receipt, positive
from crkr.client.lifetimes import Closing, check_not_forked, is_forked
from crkr.client.outbox.outbox_file import OutboxFile, Refused
from crkr.client.rpc import Rpc
from crkr.protocol import (
    Conflict,
    CrkrError,
    Internal,
    Invalid,
    Prediction,
    Receipt,
    TaskSpec,
    TrialFields,
    Unavailable,
    make_trials,
    task_key,
)
from crkr.protocol.earlier_python import Unpack

__all__ = ["Outbox"]

_logger = logging.getLogger(__name__)
_TOGETHER: Final = 256  # trials in a message; fewer on a slow link
_STREAK: Final = 10  # delivered messages after which the next ones get larger
_ATTEMPT_S: Final = 3.0  # to send one
_FIRST_PAUSE_S: Final = 0.1  # after an unanswered message
_LONGEST_PAUSE_S: Final = 2.0
_JOIN_S: Final = 0.5


@final
class Outbox(Closing):
    """Takes reports as `Task.report` does and delivers them in the background, in order; threads may share it.

    Attributes:
        path: The file.
        spec: The task's specification, as it was when the file was made.
        fault: Why the last message was not delivered; None: it was.
        defects: Deliveries that failed by a defect or for lack of memory, not by an error of the protocol.
    """

    def __init__(
        self,
        rpc: Rpc,
        task: str,
        path: Path,
        look: Callable[[float | None], tuple[TaskSpec, bool]],
        timeout_s: float | None = None,
    ) -> None:
        """Opens the file and delivers what is in it; `Task.outbox` makes one.

        Args:
            rpc: Sends the reports.
            task: The task's name.
            path: The file, made where it is not there.
            look: Asks for the task's specification and whether it is archived, within a time [s].
            timeout_s: Deadline of asking for the specification, which a new file keeps [s].

        Raises:
            StorageError: The file cannot be opened, is not an outbox, or is open already.
            Conflict: It belongs to another task.
            CrkrError: Any error of `look`.
        """
        self.path: Final = path
        self._rpc, self._task, self._look = rpc, task, look
        self._server: UUID | None = None  # server whose task was checked
        self._most, self._streak = _TOGETHER, 0  # trials in the next message; messages delivered in a row
        self._file = OutboxFile(path, task)
        try:
            self.spec: Final = self._file.spec or self._file.describe(look(timeout_s)[0])
            self._pending = self._file.pending()
        except BaseException:
            self._file.close()
            raise
        self._lock = threading.RLock()  # taken by itself: an interrupt could leave a condition's lock held
        self._changed = threading.Condition(self._lock)
        self._closing = threading.Event()
        self.fault: CrkrError | None = None
        self.defects = 0
        self._thread = threading.Thread(target=self._deliver, name=f"crkr-outbox-{task}", daemon=True)
        self._thread.start()

    @property
    def pending(self) -> int:
        """Number of trials still to be delivered."""
        return self._pending

    def refused(self) -> list[Refused]:
        """Trials that the server refused (`Invalid`, `Conflict`) or that cannot be read; the file keeps them."""
        return self._file.refused()

    def discard(self, refused: Sequence[Refused]) -> None:
        """Deletes refused trials for good."""
        self._file.discard([one.number for one in refused])

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> tuple[UUID, ...]:
        """Keeps the report of one trial or a batch.

        Args:
            answer: The prediction that was tried; or give `state` and `goal`.
            trial: What was tried and its result, see `crkr.protocol.TrialFields`.

        Returns:
            The ids, once the trials are in the file and on the disk. The server has them when `pending` says so.

        Raises:
            Invalid: A value of the wrong shape or out of range; nothing is kept.
            StorageError: The file cannot be written; nothing is kept.
            Unavailable: The outbox was closed.
        """
        check_not_forked()
        trials = make_trials(self.spec, answer, **trial)
        with self._lock:
            if self._closing.is_set():
                raise Unavailable(f"the outbox {self.path} is closed")
            try:
                self._file.add(trials)
                self._pending += len(trials)
            except CrkrError:
                raise
            except BaseException:  # an interrupt between the two
                self._pending = self._file.pending()
                raise
            finally:
                self._changed.notify_all()
        return tuple(one.id for one in trials)

    def flush(self, timeout_s: float) -> None:
        """Waits until all trials are delivered or refused.

        Raises:
            Invalid: A time that is not positive and finite.
            Unavailable: Trials are left at the deadline, or the outbox was closed; the file keeps them.
        """
        check_not_forked()
        with self._changed:
            self._changed.wait_for(lambda: not self._pending or self._closing.is_set(), positive(timeout_s))
            left = self._pending
        if left:
            why = f": {self.fault.message}" if self.fault is not None else ""
            raise Unavailable(f"{left} trials are still in the outbox {self.path}{why}", details={"pending": left})

    def close(self) -> None:
        """Ends delivery and closes the file, which keeps the rest for the next time; a second call does nothing."""
        if is_forked():
            return
        with self._lock:
            self._closing.set()
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)  # a report in flight is sent again the next time
        self._file.close()

    def __repr__(self) -> str:
        fault = self.fault.code if self.fault is not None else None
        defects = f", defects={self.defects}" if self.defects else ""
        return f"Outbox({str(self.path)!r}, task={self._task!r}, pending={self._pending}, fault={fault}{defects})"

    def _deliver(self) -> None:
        pause, over = 0.0, False
        while not over:
            try:
                over = self._closing.wait(pause) or self._deliver_once()
                pause = 0.0
            except BaseException as error:  # the trials are in the file; the next attempt may succeed
                over = self._closing.is_set()
                if not over:
                    self._note(error)
                pause = min(max(2.0 * pause, _FIRST_PAUSE_S), _LONGEST_PAUSE_S)

    def _deliver_once(self) -> bool:
        """Waits for trials and sends some; returns whether the outbox was closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._pending or self._closing.is_set())
        if self._closing.is_set():
            return True
        self._send_next()
        return False

    def _note(self, error: BaseException) -> None:
        if isinstance(error, CrkrError):
            known = error
        else:
            self.defects += 1
            known = Internal(f"the outbox {self.path} failed: {error!r:.500}")
        if self.fault is None:
            _logger.info("%d trials wait in %s: %s", self._pending, self.path, known.message)
        self.fault, self._server = known, None

    def _send_next(self) -> None:
        self._check_task()
        rows = self._file.next(self._most)
        whole = [(number, trial) for number, trial in rows if trial is not None]
        for number in {number for number, _ in rows} - {number for number, _ in whole}:
            self._put_aside(number, f"STORAGE: {self._file.why_unreadable(number)}")
        if whole:
            try:
                self._send(whole)
            except Unavailable:  # the link may be too slow for so large a message
                self._most, self._streak = max(len(whole) // 2, 1), 0
                raise
            self._streak += 1
            if self._streak % _STREAK == 0:
                self._most = min(2 * self._most, _TOGETHER)
        elif not rows:
            with self._lock:
                self._pending = self._file.pending()
        with self._lock:
            self.fault = None
            self._changed.notify_all()

    def _send(self, rows: list[tuple[int, dict[str, Any]]]) -> None:
        """Sends trials together; where one is refused, in halves until it is found."""
        try:
            message = {"trials": [trial for _, trial in rows]}
            reply = self._rpc.call(task_key(self._task, "report"), message, _ATTEMPT_S)
            with answer_to("report"):
                check_receipt(Receipt.from_wire(reply), len(rows))
        except (Invalid, Conflict) as error:
            if len(rows) > 1:
                middle = len(rows) // 2
                self._send(rows[:middle])
                self._send(rows[middle:])
                return
            self._check_task(again=True)  # the task may be wrong, not the trial
            self._put_aside(rows[0][0], f"{error.code}: {error.message}")
            return
        self._check_task()  # a server with other data may have answered
        with self._lock:
            self._file.delivered([number for number, _ in rows])
            self._pending -= len(rows)

    def _put_aside(self, number: int, error: str) -> None:
        with self._lock:
            self._file.refuse(number, error)
            self._pending -= 1
        _logger.warning("trial %d of the outbox %s was put aside: %s", number, self.path, error)

    def _check_task(self, *, again: bool = False) -> None:
        """Raises `Conflict` where the server has another task of that name, and `Invalid` where it is archived."""
        server = self._rpc.server_id(_ATTEMPT_S)
        if server == self._server and not again:
            return
        spec, archived = self._look(_ATTEMPT_S)
        if differences := _differences(self.spec, spec):
            raise Conflict(
                f"task {self._task!r} at {self._rpc.transport.endpoint} is not the task of the trials in "
                f"{self.path}: its {', '.join(differences)} differ; bring back its data, or begin another outbox",
                details={"fields": differences},
            )
        if archived:
            raise Invalid(f"task {self._task!r} is archived and takes no reports; {self.path} keeps them")
        self._server = server


def _differences(mine: TaskSpec, theirs: TaskSpec) -> dict[str, list[Any]]:
    """Differences that change the meaning of a trial: name -> [mine, theirs]."""
    both = [
        {
            "state": [(axis.name, axis.unit) for axis in spec.state],
            "goal": [(axis.name, axis.unit, axis.low, axis.high) for axis in spec.goal],
            "outcome": [(entry.name, entry.unit) for entry in spec.outcome],
        }
        for spec in (mine, theirs)
    ]
    return {name: [both[0][name], both[1][name]] for name in both[0] if both[0][name] != both[1][name]}
