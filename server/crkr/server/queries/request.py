"""One query to the server, answered exactly once."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from typing import Any, Final, Protocol, final

import zenoh

from crkr.protocol import (
    MAX_MESSAGE_BYTES,
    CrkrError,
    Internal,
    Invalid,
    check_encoding,
    encoding,
    error_to_wire,
    pack,
    split_key,
)
from crkr.protocol.codec import unpack_request
from crkr.protocol.messages.call_metadata import LONGEST_METADATA, CallMetadata
from crkr.server.metrics.durations import Latencies
from crkr.server.thread_faults import FAULTS

__all__ = ["Job", "Request", "held_bytes", "let_go", "refuse"]

logger = logging.getLogger(__name__)

_encoding = cache(lambda verb: zenoh.Encoding(encoding(verb)))  # bounded, as keys of unknown verbs are refused before
_TOO_LONG = f"a message has at most {MAX_MESSAGE_BYTES}: ask for less at once"
_ERROR_ENCODING = zenoh.Encoding(encoding("error"))
_LONGEST_KEY: Final = 512  # characters; the longest of the protocol has about 150
# Bytes. A reply carries the key of its query, and Zenoh panics over a longer one, which a declared prefix and a suffix
# can make. Such a query is dropped without an answer.
_LONGEST_REPLY_KEY: Final = 65_533
_MOST_BESIDE: Final = 2**16  # bytes of attachment and parameters
# Bytes of small messages; the others are bounded by MAX_MESSAGE_BYTES.
_MOST_BYTES: Final[Mapping[str, int]] = {
    **dict.fromkeys(("info", "tasks", "status", "spec", "model", "samples", "explain"), 2**16),
    **dict.fromkeys(("refit", "undo", "rollback", "rename", "archive", "delete"), 2**16),
    **dict.fromkeys(("create_task", "configure", "recost", "remove", "amend"), 2**20),
}
_LONGEST_ENCODING: Final = 256  # characters
_QUERY_BYTES: Final = 1024  # a query's own memory
_MOST_HASHED: Final = 2**20  # bytes; about a millisecond's work
_IDS: Final = pack({"trial_ids": None})[1:-1]
_REPEATS: Final = 2  # latest repeats of a question that are answered with it


class Job(Protocol):
    """The work of a lane: a request, or a job of the server itself."""

    held: bool
    answered: bool
    size: int
    client: bytes
    received: float
    deadline: float
    left: float

    @property
    def verb(self) -> str:
        """The verb, which chooses the queue."""

    @property
    def task(self) -> str:
        """The task's name."""

    def reply(self, message: Mapping[str, Any]) -> None:
        """Answer."""

    def fail(self, error: CrkrError) -> None:
        """Answer with an error."""

    def fail_unexpectedly(self, error: BaseException) -> None:
        """Answer with the error that was raised."""


@final
class Request:
    """A query and its parsed key.

    Attributes:
        scope: "rpc", "task" or "admin".
        task: The task's name, "" for scope "rpc".
        verb: The last part of the key.
        size: Bytes of everything that the client chose, payload included.
        held: Whether it will be answered later, outside its lane.
        patient: Whether it is long and waits in a lane, so that short requests do not wait for it.
        client: Id of the client, b"" if unknown.
        received: Time of arrival [s, `time.perf_counter`].
        deadline: When the client stops waiting [s, `time.perf_counter`], infinite if unknown.
        left: Estimate of the remaining work, to compare requests of one client.
        progress: State of the lane that works on it.
        fingerprint: Equal for repeats of one question; None unless the lane joins repeats.

    Raises:
        Invalid: The key is not one of the protocol, or attachment or parameters are too large. The caller then answers
            the query.
    """

    __slots__ = (
        "_key",
        "_latencies",
        "_outcome",
        "_query",
        "_repeats",
        "answered",
        "client",
        "deadline",
        "fingerprint",
        "held",
        "left",
        "patient",
        "progress",
        "received",
        "scope",
        "size",
        "task",
        "verb",
    )

    def __init__(self, query: zenoh.Query, latencies: Latencies) -> None:
        self.received = time.perf_counter()
        self._query = query
        self._latencies = latencies
        self.answered = self.held = self.patient = False
        self._key = query.key_expr
        key = str(self._key)
        if len(key) > _LONGEST_KEY:
            raise Invalid(f"a key has at most {_LONGEST_KEY} characters; got {len(key)}: {key[:64]}...")
        self.scope, self.task, self.verb = split_key(key)
        payload, attachment = query.payload, query.attachment
        beside = len(str(query.parameters)) + (0 if attachment is None else len(attachment))
        if beside > _MOST_BESIDE:
            raise Invalid(f"attachment and parameters have {beside} bytes; the limit is {_MOST_BESIDE}")
        length = len(key) + (0 if payload is None else len(payload))
        self.size, self.left = length + beside, float(length)
        self.client = b""
        self.deadline = math.inf
        self.progress: Any = None
        self.fingerprint: tuple[Any, ...] | None = None
        self._repeats: deque[Request] | None = None
        self._outcome: bytes | CrkrError | None = None

    def read_metadata(self) -> None:
        """Read client and deadline from the attachment, for requests that wait in a lane."""
        attachment = self._query.attachment
        self.size += _QUERY_BYTES + len(str(self._query.encoding))
        if attachment is None or len(attachment) > LONGEST_METADATA:
            return
        told = CallMetadata.from_bytes(attachment.to_bytes())
        self.client = told.client
        if told.left_ms is not None:
            self.deadline = self.received + told.left_ms / 1000

    def held_bytes(self) -> int:
        """Approximate memory of the waiting request."""
        return held_bytes(self._query)

    def payload(self) -> bytes:
        """A copy of the message's bytes; raises `Unsupported` for another version."""
        given = self._query.encoding
        if given is not None:
            name = str(given)
            check_encoding(name if len(name) <= _LONGEST_ENCODING else f"{name[:64]}...")
        payload = self._query.payload
        return b"" if payload is None else payload.to_bytes()

    def message(self) -> dict[str, Any]:
        """The decoded request; raises `Invalid` or `Unsupported`."""
        payload = self.payload()
        most = _MOST_BYTES.get(self.verb, MAX_MESSAGE_BYTES)
        if len(payload) > most:
            raise Invalid(f"a message to {self.verb} has at most {most} bytes; got {len(payload)}")
        return unpack_request(payload)

    def identify(self) -> None:
        """Compute the fingerprint of a question with trial ids, so that repeats can share its answer."""
        if self.size <= _MOST_HASHED:
            with suppress(CrkrError):  # another version, which is refused in its turn
                payload = self.payload()
                if _IDS in payload:
                    self.fingerprint = self.verb, self.task, blake2b(payload, digest_size=16).digest()

    def join(self, repeat: Request) -> Request | None:
        """Answer a repeat together with this request; the client has given up the earlier attempt.

        Returns:
            An earlier repeat that is not answered any more, for the caller to drop.
        """
        if self._repeats is None:
            self._repeats = deque()
        self._repeats.append(repeat)
        self.deadline = max(self.deadline, repeat.deadline)
        return self._repeats.popleft() if len(self._repeats) > _REPEATS else None

    def answer_repeats(self) -> None:
        """Answer the joined repeats as this request was answered."""
        while self._repeats:
            repeat = self._repeats.popleft()
            if isinstance(self._outcome, bytes):
                repeat.reply_packed(self._outcome)
            elif self._outcome is not None:
                repeat.fail(self._outcome)

    def let_go(self) -> None:
        """Drop the query unanswered, because its client is gone. May block, as a reply does."""
        if not self.answered:
            self.answered = True
            let_go(self._query)

    def reply(self, message: Mapping[str, Any]) -> None:
        """Answer."""
        self.reply_packed(pack(message))

    def reply_packed(self, payload: bytes) -> None:
        """Answer with an encoded message."""
        if self.answered:
            return
        if len(payload) > MAX_MESSAGE_BYTES:
            self.fail(Invalid(f"the answer to {self.verb} would have {len(payload)} bytes; {_TOO_LONG}"))
            return
        self.answered = True
        if self.fingerprint is not None:
            self._outcome = payload
        self._latencies.record(self.verb, time.perf_counter() - self.received)
        try:
            with self._query:
                self._query.reply(self._key, payload, encoding=_encoding(self.verb))
        except zenoh.ZError as error:  # the client left, or the session is closing
            logger.debug("reply to %s was not sent: %s", self.verb, error)
        except BaseException as error:  # a panic over this client's connection loses this answer only
            FAULTS.note(error)

    def fail(self, error: CrkrError) -> None:
        """Answer with an error."""
        if not self.answered:
            self.answered = True
            if self.fingerprint is not None:
                self._outcome = error
            self._latencies.refused(self.verb, error.code)
            refuse(self._query, error)

    def fail_unexpectedly(self, error: BaseException) -> None:
        """Answer with an exception: a `CrkrError` unchanged, others as `Internal`, with a logged traceback."""
        if not isinstance(error, CrkrError):
            if not isinstance(error, Exception):
                FAULTS.note(error)
            logger.error("%s of task %r failed", self.verb, self.task, exc_info=error)
            error = Internal(f"{self.verb} failed by a defect of the server: {type(error).__name__}; see its log")
        self.fail(error)


def _packed(error: CrkrError) -> bytes:
    """The encoded error, without its details if they do not fit into a message."""
    body = error_to_wire(error)
    packed = pack(body)
    return packed if len(packed) <= MAX_MESSAGE_BYTES else pack({**body, "details": {}})


def held_bytes(query: zenoh.Query) -> int:
    """Approximate memory of a waiting query, i.e. everything that the client chose."""
    parts = (query.payload, query.attachment)
    chosen = sum(len(part) for part in parts if part is not None)
    return _QUERY_BYTES + chosen + len(str(query.key_expr)) + len(str(query.parameters)) + len(str(query.encoding))


def refuse(query: zenoh.Query, error: CrkrError) -> None:
    """Answer a query with an error, and drop it."""
    if len(str(query.key_expr).encode()) > _LONGEST_REPLY_KEY:
        let_go(query)
        return
    try:
        with query:
            query.reply_err(_packed(error), encoding=_ERROR_ENCODING)
    except zenoh.ZError as failure:
        logger.debug("error reply was not sent: %s", failure)
    except BaseException as failure:  # as above
        FAULTS.note(failure)


def let_go(query: zenoh.Query) -> None:
    """Drop a query unanswered. Zenoh then sends that there is no answer, and waits for a client that does not read."""
    try:
        query.drop()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
    except zenoh.ZError as failure:
        logger.debug("a query was not dropped: %s", failure)
    except BaseException as failure:
        FAULTS.note(failure)
