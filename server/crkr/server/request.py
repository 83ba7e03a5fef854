"""One query on its way through the server, to be answered exactly once."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from functools import cache
from typing import Any, Protocol, final

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
    unpack,
)
from crkr.server.latency import Latencies

__all__ = ["Job", "Request", "refuse"]

logger = logging.getLogger(__name__)

_encoding = cache(lambda verb: zenoh.Encoding(encoding(verb)))  # few verbs: a key of another is refused before
_TOO_LONG = f"a message has at most {MAX_MESSAGE_BYTES}: ask for less at once"
_ERROR_ENCODING = zenoh.Encoding(encoding("error"))


class Job(Protocol):
    """What a lane works off: a request, or something that the server asks of itself."""

    held: bool
    answered: bool
    size: int

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

    def fail_unexpectedly(self, error: Exception) -> None:
        """Answers with whatever was raised."""
        ...


@final
class Request:
    """A query with its key taken apart.

    Attributes:
        scope: "rpc", "task" or "admin".
        task: The task's name, "" for scope "rpc".
        verb: The last part of the key.
        size: Bytes of the payload.
        held: Somebody took it over and will answer it later.
        patient: It takes long and waits in a lane, where it holds up nobody who asks for little.

    Raises:
        Invalid: The key is none of the protocol's; the query is left to the caller.
    """

    __slots__ = (
        "_key",
        "_latencies",
        "_payload",
        "_query",
        "_received",
        "answered",
        "held",
        "patient",
        "scope",
        "size",
        "task",
        "verb",
    )

    def __init__(self, query: zenoh.Query, latencies: Latencies) -> None:
        self._received = time.perf_counter()
        self._query = query
        self._latencies = latencies
        self.answered = self.held = self.patient = False
        self._key = query.key_expr
        self.scope, self.task, self.verb = split_key(str(self._key))
        payload = query.payload
        self._payload = b"" if payload is None else payload.to_bytes()
        self.size = len(self._payload)

    def payload(self) -> bytes:
        """The request's bytes; raises `Unsupported` where they are of another version."""
        given = self._query.encoding
        if given is not None:
            check_encoding(str(given))
        return self._payload

    def message(self) -> dict[str, Any]:
        """The decoded request; raises `Invalid` or `Unsupported`."""
        return unpack(self.payload())

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
        self._latencies.record(self.verb, time.perf_counter() - self._received)
        try:
            with self._query:
                self._query.reply(self._key, payload, encoding=_encoding(self.verb))
        except zenoh.ZError as error:  # the client left, or the session is closing: nobody waits for this answer
            logger.debug("reply to %s was not sent: %s", self.verb, error)

    def fail(self, error: CrkrError) -> None:
        """Answers with an error."""
        if not self.answered:
            self.answered = True
            self._latencies.refused(self.verb, error.code)
            refuse(self._query, error)

    def fail_unexpectedly(self, error: Exception) -> None:
        """Answers with what was raised: a `CrkrError` as it is, anything else as a defect whose traceback is logged."""
        if not isinstance(error, CrkrError):
            logger.error("%s of task %r failed", self.verb, self.task, exc_info=error)
            error = Internal(f"{self.verb} failed by a defect of the server: {type(error).__name__}; see its log")
        self.fail(error)


def _packed(error: CrkrError) -> bytes:
    """The error's message map, without details where they are too many for a message."""
    body = error_to_wire(error)
    packed = pack(body)
    return packed if len(packed) <= MAX_MESSAGE_BYTES else pack({**body, "details": {}})


def refuse(query: zenoh.Query, error: CrkrError) -> None:
    """Answers a query with an error, and lets go of it."""
    try:
        with query:
            query.reply_err(_packed(error), encoding=_ERROR_ENCODING)
    except zenoh.ZError as failure:
        logger.debug("error reply was not sent: %s", failure)
