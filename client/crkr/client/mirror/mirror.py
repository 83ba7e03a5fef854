"""A local copy of a task's policy, for predictions without the network.

The server sends a notice when it has a new model; the mirror also asks every second, in case it missed one. A thread
fetches the whole model and replaces the old one in one step, so predictions neither wait nor see half a model.
"""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Final, final
from uuid import UUID

from crkr.client.checks import positive
from crkr.client.lifetimes import Closing, check_not_forked, is_forked
from crkr.client.mirror.model_reader import ModelReader, ModelSource
from crkr.client.network.subscription import Subscription
from crkr.client.rpc import Rpc
from crkr.client.transport import Transport
from crkr.learner import Model
from crkr.protocol import (
    Array,
    CrkrError,
    Internal,
    Invalid,
    Prediction,
    Receipt,
    TrialFields,
    Unavailable,
    check_states,
    random_ids,
)
from crkr.protocol.earlier_python import Unpack

__all__ = ["Mirror"]

_logger = logging.getLogger(__name__)
_ATTEMPT_S: Final = 2.0  # to ask in the background
_JOIN_S: Final = 0.2  # an unanswered attempt ends by itself
_EXIT_S: Final = 1.0  # at the end of the interpreter, for predictions in progress


@final
class Mirror(Closing):
    """Answers as the task does, from a copy that is refreshed in the background; threads may share it.

    The copy does not use outcomes. Where they guide the task's goals, it answers with the plain mean, or explores as
    the paper does; `policy` says which.

    Attributes:
        name: The task's name.
        fault: Why the last refresh failed; None: it did not.
        defects: Refreshes that failed by a defect or for lack of memory, not by an error of the protocol.
    """

    def __init__(
        self,
        task: ModelSource,
        rpc: Rpc,
        check_bounds: Callable[[Array, Array], None],
        *,
        every_s: float = 1.0,
        pause_s: float = 0.1,
        max_age_s: float | None = None,
        timeout_s: float | None = None,
    ) -> None:
        """Fetches the first copy; `Task.mirror` makes one.

        Args:
            task: The task to copy.
            rpc: Asks which server answers.
            check_bounds: Raises `Invalid` where a first copy's bounds of goals are not the task's.
            every_s: Longest time between two checks for a new model [s]; at most a third of `max_age_s`.
            pause_s: Shortest time between two copies [s]; at most a third of `max_age_s`.
            max_age_s: Age from which predictions are refused [s]; None: never.
            timeout_s: Deadline of the first copy [s].

        Raises:
            Invalid: A time that is not positive.
            Unavailable: No answer by the deadline.
            UnknownTask: There is no such task.
        """
        for name, value in {"every_s": every_s, "pause_s": pause_s, "max_age_s": max_age_s}.items():
            if value is not None and not 0.0 < value < float("inf"):
                raise Invalid(f"{name} must be a positive number of seconds; got {value!r}", details={"field": name})
        self.name: Final = task.name
        self._task, self._rpc, self._max_age_s = task, rpc, max_age_s
        self._reader = ModelReader(task, rpc, check_bounds)
        at_most = float("inf") if max_age_s is None else max_age_s / 3.0
        self._every_s, self._pause_s = min(every_s, at_most), min(pause_s, at_most)
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._exiting = threading.Event()
        self._inside: dict[int, None] = {}  # threads that are predicting
        self.fault: CrkrError | None = None
        self.defects = 0
        self._refreshing = threading.RLock()  # if an interrupt leaves it held, its thread can still take it
        # Before the first copy, or a change between the two would be noticed late.
        self._notices = task.subscribe(("model",), capacity=1, timeout_s=timeout_s)
        try:
            self._model, self._confirmed = self._reader.fetch(None, timeout_s)
        except BaseException:
            self._notices.close()
            raise
        self._thread = threading.Thread(target=self._follow, name=f"crkr-mirror-{self.name}", daemon=True)
        self._thread.start()
        ours = (self._exiting, self._closed, self._inside, self._notices, self._thread, rpc.transport)
        self._exit = weakref.finalize(self, _exit, *ours)

    @property
    def model(self) -> Model:
        """The current copy, immutable."""
        return self._model

    @property
    def model_version(self) -> int:
        """Log position that the copy has applied."""
        return self._model.version

    @property
    def age_s(self) -> float:
        """Time since the server last confirmed that the copy is its model [s]."""
        return time.monotonic() - self._confirmed

    def predict(
        self, states: object, explore: bool = False, *, trial_ids: Sequence[UUID | bytes] | None = None
    ) -> Prediction:
        """Goals for one state (d,) or a batch (b, d), as `Task.predict`.

        Raises:
            Invalid: States of another shape, or not finite.
            NoSamples: Nothing was learned yet.
            NovelState: The task refuses states this far from its samples.
            Unavailable: The copy is older than `max_age_s`, or was closed.
        """
        me = threading.get_ident()
        self._inside[me] = None
        try:
            self._check()
            model = self._model
            if trial_ids is not None:
                return model.predict(states, explore, trial_ids)
            checked = check_states(states, len(model.parameters.kernel.centre))
            ids = random_ids(1 if checked.ndim == 1 else len(checked))
            return model.answer(checked, explore, [UUID(bytes=one) for one in ids])
        finally:
            self._inside.pop(me, None)

    def report(
        self,
        answer: Prediction | None = None,
        *,
        wait: bool = False,
        timeout_s: float | None = None,
        **trial: Unpack[TrialFields],
    ) -> Receipt:
        """Reports to the server, as `Task.report`; the copy has it after the next refresh."""
        return self._task.report(answer, wait=wait, timeout_s=timeout_s, **trial)

    def refresh(self, timeout_s: float | None = None) -> bool:
        """Asks now; returns whether there was a newer model.

        Raises:
            Unavailable: No answer by the deadline, or the mirror was closed.
            UnknownTask: The server no longer has the task.
            Conflict: The server has another task of that name, with other states or goals.
        """
        self._check_open()
        deadline = self._rpc.deadline(timeout_s)
        if not self._refreshing.acquire(timeout=max(deadline - time.monotonic(), 0.0)):
            raise Unavailable(f"another refresh of the local copy of task {self.name!r} was in progress")
        try:
            before = self._model
            model, confirmed = self._reader.fetch(before, max(deadline - time.monotonic(), 0.001))
            with self._changed:
                self._model, self._confirmed, self.fault = model, confirmed, None
                self._changed.notify_all()
        except CrkrError as error:
            self.fault = error
            raise
        finally:
            self._refreshing.release()
        return model is not before

    def wait_for(self, version: int, timeout_s: float) -> None:
        """Waits until the copy has applied a log position, e.g. the last of a receipt's `seqs`.

        Raises:
            Invalid: A time that is not positive and finite.
            Unavailable: It has not by the deadline, or the mirror was closed.
        """
        check_not_forked()
        with self._changed:
            self._changed.wait_for(lambda: self._model.version >= version or self._closed.is_set(), positive(timeout_s))
        if self._model.version < version:
            self._end_with_interpreter()
            why = f" ({self.fault.message})" if self.fault is not None else ""
            raise Unavailable(
                f"the local copy of task {self.name!r} is at log position {self._model.version}, before {version}{why}",
                details={"version": self._model.version},
            )

    def close(self) -> None:
        """Ends refreshing; a second call does nothing. Predictions stay valid."""
        if is_forked():
            return
        self._exit.detach()
        self._closed.set()
        with self._changed:
            self._changed.notify_all()
        self._notices.close()
        if threading.current_thread() is not self._thread:
            self._thread.join(_JOIN_S)

    def __repr__(self) -> str:
        fault = self.fault.code if self.fault is not None else None
        return (
            f"Mirror({self.name!r}, model_version={self.model_version}, active={self._model.active}, "
            f"age_s={self.age_s:.1f}, fault={fault}{f', defects={self.defects}' if self.defects else ''})"
        )

    def _end_with_interpreter(self) -> None:
        """Blocks a daemon thread forever once the interpreter ends, so that it does not enter scipy again."""
        if self._exiting.is_set() and threading.current_thread() is not threading.main_thread():
            self._inside.pop(threading.get_ident(), None)
            threading.Event().wait()

    def _check_open(self) -> None:
        check_not_forked()  # nothing refreshes it in the child
        if self._closed.is_set():
            self._end_with_interpreter()
            raise Unavailable(f"the local copy of task {self.name!r} was closed")

    def _check(self) -> None:
        self._check_open()
        if self._max_age_s is not None and (age := self.age_s) > self._max_age_s:
            why = f" ({self.fault.message})" if self.fault is not None else ""
            raise Unavailable(
                f"the local copy of task {self.name!r} is {age:.1f} s old, more than {self._max_age_s:g} s{why}",
                details={"age_s": age, "limit": self._max_age_s},
            )

    def _follow(self) -> None:
        """Refreshes after each notice, and at least every `every_s`."""
        over = False
        while not over:
            try:
                over = self._closed.wait(self._pause_s) or self._follow_once()
            except BaseException as error:  # the next attempt may succeed; `fault` and `age_s` tell
                self._note(error)

    def _follow_once(self) -> bool:
        """Waits for a notice and refreshes; returns whether it was the last time."""
        self._notices.receive(self._every_s)
        if self._closed.is_set():
            return True
        over = self._notices.closed  # closed with the client, as this last attempt will say
        try:
            self.refresh(_ATTEMPT_S)
        except CrkrError as error:
            self._note(error)
        return over

    def _note(self, error: BaseException) -> None:
        """Records a failed refresh; logs a defect as a warning once, and counts each in `defects`."""
        if isinstance(error, CrkrError):
            self.fault = error
            _logger.debug("the local copy of task %s was not refreshed: %s", self.name, error)
            return
        self.defects += 1
        self.fault = Internal(f"the local copy of task {self.name!r} was not refreshed: {error!r:.500}")
        level = logging.WARNING if self.defects == 1 else logging.DEBUG
        _logger.log(level, "the local copy of task %s was not refreshed: %r", self.name, error)


def _exit(
    exiting: threading.Event,
    closed: threading.Event,
    inside: dict[int, None],
    notices: Subscription,
    thread: threading.Thread,
    transport: Transport,
) -> None:
    """Waits until no thread is inside scipy before the interpreter ends.

    Interpreter exit kills daemon threads, which aborts the process inside scipy's C++ code.
    """
    if is_forked():
        return
    exiting.set()
    closed.set()
    notices.close()
    transport.close()  # ends a question in progress
    until = time.monotonic() + _EXIT_S
    thread.join(_EXIT_S)
    while inside and time.monotonic() < until:
        threading.Event().wait(0.001)
