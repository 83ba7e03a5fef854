"""Publications of a task, buffered for a slow reader; a full buffer drops and counts the oldest."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import Sequence
from typing import Any, Final, final

import zenoh

from crkr.client.checks import plain
from crkr.client.lifetimes import Closing, hold, is_forked, release
from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    MAX_TELEMETRY_BYTES,
    CrkrError,
    Invalid,
    check_encoding,
    pub_key,
    unpack,
)

__all__ = ["TOPICS", "Subscription"]

_logger = logging.getLogger(__name__)
_JOIN_S: Final = 2.0
_REST_S: Final = 0.05  # after a defect, which may recur at once
_MOST_BYTES: Final = 64 << 20  # of publications in the buffer
TOPICS: Final = ("trial", "evaluation", "model")


@final
class _Buffer:
    """Publications that a thread has taken from Zenoh, so that Zenoh's threads never wait for the reader."""

    def __init__(self, capacity: int) -> None:
        self.messages: deque[tuple[str, bytes]] = deque()
        self.dropped = 0
        self.skipped = 0
        self.subscribers = 0  # two for a moment, while it moves to another session
        self.changed = threading.Condition()
        self._capacity, self._bytes = capacity, 0

    def fill(self, samples: zenoh.handlers.Handler[zenoh.Sample], topics: Sequence[str]) -> None:
        """Takes samples until the subscriber is undeclared; counts those that raise an error of any kind."""
        pause = threading.Event()
        try:
            while True:
                try:
                    self._take(samples.recv(), topics)
                except zenoh.ZError:  # the subscriber is gone
                    return
                except BaseException as error:  # a panic in the binding is a BaseException
                    self.skip("?", error)
                    pause.wait(_REST_S)
        finally:
            with self.changed:
                self.subscribers -= 1
                self.changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether nothing fills it."""
        return self.subscribers == 0

    def pop(self) -> tuple[str, bytes]:
        """Removes the oldest; call it with `changed` held."""
        topic, data = self.messages.popleft()
        self._bytes -= len(data)
        return topic, data

    def skip(self, topic: str, error: BaseException) -> None:
        """Counts a publication that cannot be read."""
        self.skipped += 1
        _logger.debug("skipped a publication on %s: %s", topic, error)

    def _take(self, sample: zenoh.Sample, topics: Sequence[str]) -> None:
        topic = str(sample.key_expr).rpartition("/")[2]
        if topic not in topics:
            return
        try:
            check_encoding(str(sample.encoding))
            most = MAX_MESSAGE_BYTES if topic == "model" else MAX_TELEMETRY_BYTES
            if len(sample.payload) > most:
                raise Invalid(f"it has {len(sample.payload)} bytes; the limit is {most}")
        except CrkrError as error:
            self.skip(topic, error)
            return
        data = sample.payload.to_bytes()
        with self.changed:
            self.messages.append((topic, data))
            self._bytes += len(data)
            while len(self.messages) > self._capacity or (self._bytes > _MOST_BYTES and len(self.messages) > 1):
                self.pop()
                self.dropped += 1
            self.changed.notify()


@final
class Subscription(Closing):
    """Receives publications until closed, also after the server restarts."""

    def __init__(self, session: zenoh.Session, task: str, topics: Sequence[str], capacity: int) -> None:
        unknown = [topic for topic in topics if topic not in TOPICS]
        if unknown or not topics or capacity < 1:
            raise Invalid(f"subscribe to one or more of {', '.join(TOPICS)} with capacity >= 1; got {topics!r}")
        self._task, self._topics, self._buffer = task, tuple(topics), _Buffer(capacity)
        self._finalizer = self._subscribe(session)

    def _subscribe(self, session: zenoh.Session) -> weakref.finalize[..., Subscription]:
        # One subscriber for several topics keeps their order.
        topic = self._topics[0] if len(self._topics) == 1 else "*"
        subscriber = session.declare_subscriber(pub_key(self._task, topic), zenoh.handlers.FifoChannel(1024))
        with self._buffer.changed:
            self._buffer.subscribers += 1
        thread = threading.Thread(
            target=self._buffer.fill, args=(subscriber.handler, self._topics), name=f"crkr-{self._task}", daemon=True
        )
        try:
            thread.start()
        except BaseException:  # the system has no thread left
            with self._buffer.changed:
                self._buffer.subscribers -= 1
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
            raise
        hold(self, subscriber)
        return weakref.finalize(self, _undeclare, subscriber, thread)

    def move(self, session: zenoh.Session) -> None:
        """As `Declared.move`."""
        if self._finalizer.alive:
            self._finalizer, earlier = self._subscribe(session), self._finalizer
            if (end := earlier.detach()) is None:  # closed meanwhile
                self.close()
            else:
                end[1](*end[2])

    @property
    def dropped(self) -> int:
        """Publications dropped here because the reader was slow; Zenoh may drop more and does not count them."""
        return self._buffer.dropped

    @property
    def skipped(self) -> int:
        """Publications that could not be decoded; any client may publish anything unless access control forbids it."""
        return self._buffer.skipped

    @property
    def closed(self) -> bool:
        """Whether no more publications will come."""
        return self._buffer.closed

    def receive(self, timeout_s: float) -> tuple[str, dict[str, Any]] | None:
        """The next publication as (topic, message), or None if there is none within `timeout_s` or ever again."""
        buffer, deadline = self._buffer, time.monotonic() + timeout_s
        while True:
            with buffer.changed:
                buffer.changed.wait_for(
                    lambda: buffer.messages or buffer.closed, timeout=max(0.0, deadline - time.monotonic())
                )
                if not buffer.messages:
                    return None
                topic, data = buffer.pop()
            try:
                return topic, plain(unpack(data))
            except (CrkrError, RecursionError, ValueError, TypeError) as error:
                buffer.skip(topic, error)

    def close(self) -> None:
        """Ends the subscription; a `receive` in progress returns."""
        self._finalizer()
        release(self)


def _undeclare(subscriber: zenoh.Subscriber[Any], thread: threading.Thread) -> None:
    if is_forked():
        return
    try:
        subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
    except zenoh.ZError as error:
        _logger.debug("undeclaring: %s", error)
    if threading.current_thread() is not thread:  # it is, where the garbage collector runs there
        thread.join(_JOIN_S)  # interpreter exit would abort the process while the thread is inside Zenoh
