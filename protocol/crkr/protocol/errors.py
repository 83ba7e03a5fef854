"""Errors with one meaning on both sides of the wire.

CrkrError
├── Invalid        INVALID         the request is malformed or out of range; sending it again cannot help
├── UnknownTask    UNKNOWN_TASK    no task of that name
├── NoSamples      NO_SAMPLES      nothing to predict from yet
├── NovelState     NOVEL_STATE     the task refuses states this far from its samples
├── Conflict       CONFLICT        the same name or id with other content
├── Busy           BUSY            a queue is full; retry after `retry_ms`
├── Unsupported    UNSUPPORTED     this verb, version or setting is not offered
├── StorageError   STORAGE         the log cannot be written or read
├── ShuttingDown   SHUTTING_DOWN   the server is leaving; its successor will answer
├── Internal       INTERNAL        a defect of the server
└── Unavailable    (never on the wire) no answer within the deadline: the outcome is unknown
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from typing import Any, ClassVar, Final, final

from crkr.protocol.plain_text import printable

__all__ = [
    "Busy",
    "Conflict",
    "CrkrError",
    "Internal",
    "Invalid",
    "NoSamples",
    "NovelState",
    "ShuttingDown",
    "StorageError",
    "Unavailable",
    "UnknownTask",
    "Unsupported",
    "error_from_wire",
    "error_to_wire",
    "shown",
]

_REPR: Final = reprlib.Repr()
_REPR.maxlevel, _REPR.maxstring, _REPR.maxother, _REPR.maxlong = 2, 60, 60, 60


def shown(value: object) -> str:
    """A value in a message: at most 80 characters, however large or deep it is."""
    try:
        return f"{_REPR.repr(value):.80}"
    except Exception:  # any repr may fail, e.g. that of an integer with thousands of digits
        return f"a value of type {type(value).__name__}"


class CrkrError(Exception):
    """Root of every error that crkr raises on purpose.

    Attributes:
        message: What happened, what was expected, what to do.
        retry_ms: When it is worth asking again [ms], or None.
        details: Plain data for programs.
    """

    code: ClassVar[str] = "INTERNAL"

    def __init__(self, message: str, *, retry_ms: int | None = None, details: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.retry_ms = retry_ms
        self.details = dict(details or {})


@final
class Invalid(CrkrError):
    """The request is malformed, of the wrong shape or out of range."""

    code = "INVALID"


@final
class UnknownTask(CrkrError):
    """The server has no task of that name."""

    code = "UNKNOWN_TASK"


@final
class NoSamples(CrkrError):
    """The active set is empty: report a demonstration first."""

    code = "NO_SAMPLES"


@final
class NovelState(CrkrError):
    """The state's novelty exceeds the task's limit and the task refuses to extrapolate."""

    code = "NOVEL_STATE"


@final
class Conflict(CrkrError):
    """The id or name exists with other content."""

    code = "CONFLICT"


@final
class Busy(CrkrError):
    """A queue of the server is full."""

    code = "BUSY"


@final
class Unsupported(CrkrError):
    """The verb, protocol version or setting is not offered here."""

    code = "UNSUPPORTED"


@final
class StorageError(CrkrError):
    """The task log cannot be written or read."""

    code = "STORAGE"


@final
class ShuttingDown(CrkrError):
    """The server is shutting down."""

    code = "SHUTTING_DOWN"


@final
class Internal(CrkrError):
    """A defect of the server; its log has the traceback."""

    code = "INTERNAL"


@final
class Unavailable(CrkrError):
    """No answer within the deadline; whether the request was executed is unknown."""

    code = "UNAVAILABLE"


_LONGEST: Final = 4096  # characters of a message, which may quote a long request
_ON_THE_WIRE: Mapping[str, type[CrkrError]] = {
    kind.code: kind
    for kind in (
        Invalid,
        UnknownTask,
        NoSamples,
        NovelState,
        Conflict,
        Busy,
        Unsupported,
        StorageError,
        ShuttingDown,
        Internal,
    )
}


def error_to_wire(error: CrkrError) -> dict[str, Any]:
    """The body of an error reply: code, message (a long one cut) and, where given, retry_ms and details."""
    message = error.message if len(error.message) <= _LONGEST else error.message[: _LONGEST - 4] + " ..."
    body: dict[str, Any] = {"code": error.code, "message": message}
    if error.retry_ms is not None:
        body["retry_ms"] = error.retry_ms
    if error.details:
        body["details"] = error.details
    return body


def error_from_wire(body: Mapping[str, Any]) -> CrkrError:
    """The exception for an error reply; an unknown code becomes `Internal` that names it.

    Control characters in its message are escaped, because programs print it.
    """
    code, message = str(body.get("code", "")), printable(str(body.get("message", "")))
    retry_ms, details = body.get("retry_ms"), body.get("details")
    kind = _ON_THE_WIRE.get(code)
    if kind is None:
        kind, message = Internal, f"error code {code!r} is not known to this client: {message}"
    return kind(
        message,
        retry_ms=retry_ms if isinstance(retry_ms, int) else None,
        details=details if isinstance(details, Mapping) else None,
    )
