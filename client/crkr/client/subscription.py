"""Publications of a task, kept for a reader who may be slow: the newest stay, the oldest are dropped and counted."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Final, final

import zenoh

from crkr.client.forks import hold, is_forked, release
from crkr.client.rpc import plain
from crkr.protocol import MAX_TELEMETRY_BYTES, CrkrError, Invalid, check_encoding, pub_key, unpack

__all__ = ["TOPICS", "Subscription"]

_logger = logging.getLogger(__name__)
_JOIN_S: Final = 2.0
TOPICS: Final = ("trial", "evaluation", "model")


@final
class _Buffer:
    """What a thread of its own has taken from Zenoh, so that Zenoh's threads never wait for the reader."""

    def __init__(self, capacity: int) -> None:
        self.messages: deque[tuple[str, bytes]] = deque(maxlen=capacity)
        self.dropped = 0
        self.closed = False
        self.changed = threading.Condition()

    def fill(self, samples: zenoh.handlers.Handler[zenoh.Sample], topics: Sequence[str]) -> None:
        """Takes samples until the subscriber is gone."""
        try:
            for sample in samples:
                self._take(sample, topics)
        finally:
            with self.changed:
                self.closed = True
                self.changed.notify_all()

    def _take(self, sample: zenoh.Sample, topics: Sequence[str]) -> None:
        try:
            topic = str(sample.key_expr).rpartition("/")[2]
            if topic in topics:
                self._put(topic, sample)
        except BaseException as error:  # a binding's panic too: the next publication may be well
            _logger.warning("skipped a publication: %s: %s", type(error).__name__, error)

    def _put(self, topic: str, sample: zenoh.Sample) -> None:
        try:
            check_encoding(str(sample.encoding))
        except CrkrError as error:
            _logger.debug("skipped a publication on %s: %s", topic, error)
            return
        if len(sample.payload) > MAX_TELEMETRY_BYTES:
            _logger.debug("skipped a publication on %s of %d bytes", topic, len(sample.payload))
            return
        with self.changed:
            self.dropped += len(self.messages) == self.messages.maxlen
            self.messages.append((topic, sample.payload.to_bytes()))
            self.changed.notify()


@final
class Subscription:
    """Receives publications until closed; goes on by itself after the server restarts."""

    def __init__(self, session: zenoh.Session, task: str, topics: Sequence[str], capacity: int) -> None:
        unknown = [topic for topic in topics if topic not in TOPICS]
        if unknown or not topics or capacity < 1:
            raise Invalid(f"subscribe to one or more of {', '.join(TOPICS)} with capacity >= 1; got {topics!r}")
        # One subscriber for several topics keeps their order.
        subscriber = session.declare_subscriber(
            pub_key(task, topics[0] if len(topics) == 1 else "*"), zenoh.handlers.FifoChannel(1024)
        )
        self._buffer = _Buffer(capacity)
        self._thread = threading.Thread(
            target=self._buffer.fill, args=(subscriber.handler, tuple(topics)), name=f"crkr-{task}", daemon=True
        )
        self._thread.start()
        self._finalizer = weakref.finalize(self, _undeclare, subscriber, self._thread)
        hold(self, subscriber)

    @property
    def dropped(self) -> int:
        """Publications lost here because the reader was slow; Zenoh may lose more on the way and does not count."""
        return self._buffer.dropped

    @property
    def closed(self) -> bool:
        """Nothing more will come."""
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
                topic, data = buffer.messages.popleft()
            try:
                return topic, plain(unpack(data))
            except Invalid as error:
                _logger.debug("skipped a publication on %s: %s", topic, error)

    def close(self) -> None:
        """Ends the subscription; a `receive` in progress returns."""
        self._finalizer()
        release(self)

    def __enter__(self) -> Subscription:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _undeclare(subscriber: zenoh.Subscriber[Any], thread: threading.Thread) -> None:
    if is_forked():
        return
    try:
        subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
    except zenoh.ZError as error:
        _logger.debug("undeclaring: %s", error)
    if threading.current_thread() is not thread:  # as a garbage collector's
        thread.join(_JOIN_S)  # in Zenoh, the end of the interpreter would abort the process
