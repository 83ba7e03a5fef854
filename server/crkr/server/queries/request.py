"""One query on its way through the server, to be answered exactly once."""

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

_encoding = cache(lambda verb: zenoh.Encoding(encoding(verb)))  # few verbs: a key of another is refused before
_TOO_LONG = f"a message has at most {MAX_MESSAGE_BYTES}: ask for less at once"
_ERROR_ENCODING = zenoh.Encoding(encoding("error"))
_LONGEST_KEY: Final = 512  # characters; the longest of the protocol has about 150
# Bytes. A reply carries the key of its query, and Zenoh panics over a longer one, which a query may have that is put
# together from a declared prefix and a suffix. Such a query is let go of without a word.
_LONGEST_REPLY_KEY: Final = 65_533
_MOST_BESIDE: Final = 2**16  # bytes of an attachment and parameters, which the protocol hardly uses
# Bytes of the messages that hold little; all others are bounded by MAX_MESSAGE_BYTES.
_MOST_BYTES: Final[Mapping[str, int]] = {
    **dict.fromkeys(("info", "tasks", "status", "spec", "model", "samples", "explain", "refit", "archive"), 2**16),
    **dict.fromkeys(("create_task", "configure", "recost", "remove"), 2**20),
}
_LONGEST_ENCODING: Final = 256  # characters
_QUERY_BYTES: Final = 1024  # that a query takes besides what its asker chose
_MOST_HASHED: Final = 2**20  # bytes; about a millisecond's work
_IDS: Final = pack({"trial_ids": None})[1:-1]
_REPEATS: Final = 2  # askers of the same question that are answered with it, the latest


class Job(Protocol):
    """What a lane works off: a request, or something that the server asks of itself."""

    held: bool
    answered: bool
    size: int
    client: bytes
    received: float
    deadline: float
    left: float

    @property
    def verb(self) -> str:
        """Which queue it waits in."""
        ...

    @property
    def task(self) -> str:
        """The task's name."""
        ...

    def reply(self, message: Mapping[str, Any]) -> None:
        """Answers."""
        ...

    def fail(self, error: CrkrError) -> None:
        """Answers with an error."""
        ...

    def fail_unexpectedly(self, error: BaseException) -> None:
        """Answers with whatever was raised."""
        ...


@final
class Request:
    """A query with its key taken apart.

    Attributes:
        scope: "rpc", "task" or "admin".
        task: The task's name, "" for scope "rpc".
        verb: The last part of the key.
        size: Bytes of the payload and of all else that its asker chose.
        held: Somebody took it over and will answer it later.
        patient: It takes long and waits in a lane, where it holds up nobody who asks for little.
        client: Whose it is, b"" where that is not known.
        received: When it came [s, `time.perf_counter`].
        deadline: When its asker stops waiting [s, `time.perf_counter`], infinite where that is not known.
        left: About how much is left to do of it, to be compared with other requests of its client.
        progress: What was worked out so far, for the lane that it is in.
        fingerprint: What a repeat of the same question has in common with it, None where that is not asked.

    Raises:
        Invalid: The key is none of the protocol's; the query is left to the caller.
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
        """Finds out who asks and how long the asker waits; for what waits in a lane."""
        attachment = self._query.attachment
        self.size = self.held_bytes()
        if attachment is None or len(attachment) > LONGEST_METADATA:
            return
        told = CallMetadata.from_bytes(attachment.to_bytes())
        self.client = told.client
        if told.left_ms is not None:
            self.deadline = self.received + told.left_ms / 1000

    def held_bytes(self) -> int:
        """What it takes of memory while it waits, about."""
        return held_bytes(self._query)

    def payload(self) -> bytes:
        """A copy of the request's bytes; raises `Unsupported` where they are of another version."""
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
        """Takes the fingerprint of a question that fixes the ids of its answer: repeats of it may share one answer."""
        if self.size <= _MOST_HASHED:
            with suppress(CrkrError):  # of another version, which its turn will tell
                payload = self.payload()
                if _IDS in payload:
                    self.fingerprint = self.verb, self.task, blake2b(payload, digest_size=16).digest()

    def join(self, repeat: Request) -> None:
        """Answers a repeat of the same question with this one: its asker gave up the attempt before."""
        if self._repeats is None:
            self._repeats = deque()
        self._repeats.append(repeat)
        self.deadline = max(self.deadline, repeat.deadline)
        while len(self._repeats) > _REPEATS:
            self._repeats.popleft().let_go()

    def answer_repeats(self) -> None:
        """Answers those that joined, as this one was answered."""
        while self._repeats:
            repeat = self._repeats.popleft()
            if isinstance(self._outcome, bytes):
                repeat.reply_packed(self._outcome)
            elif self._outcome is not None:
                repeat.fail(self._outcome)

    def let_go(self) -> None:
        """Ends the query without an answer, for one whose asker is gone."""
        if not self.answered:
            self.answered = True
            let_go(self._query)

    def reply(self, message: Mapping[str, Any]) -> None:
        """Answers."""
        self.reply_packed(pack(message))

    def reply_packed(self, payload: bytes) -> None:
        """Answers with an encoded message."""
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
        except zenoh.ZError as error:  # the client left, or the session is closing: nobody waits for this answer
            logger.debug("reply to %s was not sent: %s", self.verb, error)
        except BaseException as error:  # Zenoh panicked over this client's connection: this answer is lost, no other
            FAULTS.note(error)

    def fail(self, error: CrkrError) -> None:
        """Answers with an error."""
        if not self.answered:
            self.answered = True
            if self.fingerprint is not None:
                self._outcome = error
            self._latencies.refused(self.verb, error.code)
            refuse(self._query, error)

    def fail_unexpectedly(self, error: BaseException) -> None:
        """Answers with what was raised: a `CrkrError` as it is, anything else as a defect whose traceback is logged."""
        if not isinstance(error, CrkrError):
            if not isinstance(error, Exception):
                FAULTS.note(error)
            logger.error("%s of task %r failed", self.verb, self.task, exc_info=error)
            error = Internal(f"{self.verb} failed by a defect of the server: {type(error).__name__}; see its log")
        self.fail(error)


def _packed(error: CrkrError) -> bytes:
    """The error's message map, without details where they are too many for a message."""
    body = error_to_wire(error)
    packed = pack(body)
    return packed if len(packed) <= MAX_MESSAGE_BYTES else pack({**body, "details": {}})


def held_bytes(query: zenoh.Query) -> int:
    """What a query that waits takes of memory, about: all that its asker chose."""
    parts = (query.payload, query.attachment)
    chosen = sum(len(part) for part in parts if part is not None)
    return _QUERY_BYTES + chosen + len(str(query.key_expr)) + len(str(query.parameters)) + len(str(query.encoding))


def refuse(query: zenoh.Query, error: CrkrError) -> None:
    """Answers a query with an error, and lets go of it."""
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
    """Ends a query without an answer."""
    try:
        query.drop()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
    except zenoh.ZError as failure:
        logger.debug("a query was not let go of: %s", failure)
    except BaseException as failure:
        FAULTS.note(failure)
