"""The content of an outbox's rows: a trial as its message's bytes, and a digest of them."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any, Final, TypeGuard
from uuid import UUID

from crkr.protocol import CrkrError, Invalid, TaskSpec, Trial, pack, unpack
from crkr.protocol.codec import salvage

__all__ = [
    "digest_of",
    "is_intact",
    "packed_trial",
    "readable_spec",
    "salvaged_trial",
    "sendable_trial",
    "trial_id",
]

_MEANING: Final = ("name", "description", "state", "goal", "outcome")  # fields of a specification


def packed_trial(trial: Trial, spec: TaskSpec | None) -> bytes:
    """A trial's bytes; raises `Invalid` unless the server will read the trial back as it was given."""
    body = pack(trial.to_wire())
    try:
        message = unpack(body)
        same = spec is None or pack(Trial.from_wire(message, spec).to_wire()) == body
    except Invalid as error:
        where = "its info" if _is_read_without_info(trial) else "it"
        raise Invalid(f"the trial cannot be kept: {where} cannot be read back ({error.message})") from error
    if not same:
        raise Invalid(
            "the trial cannot be kept: it would not be read back as it was given; is all of its info plain data?"
        )
    return body


def _is_read_without_info(trial: Trial) -> bool:
    message = trial.to_wire()
    message.pop("info", None)
    try:
        unpack(pack(message))
    except Invalid:
        return False
    return True


def readable_spec(fields: dict[str, Any]) -> TaskSpec:
    """The specification; if its settings are refused today, only the fields that give the trials their meaning."""
    try:
        return TaskSpec.from_dict(fields)
    except Invalid:
        return TaskSpec.from_dict({name: fields[name] for name in _MEANING if name in fields})


def sendable_trial(body: object, digest: object) -> dict[str, Any] | None:
    """The trial of an intact row that can be sent, or None."""
    if not is_intact(body, digest):
        return None
    try:
        return unpack(body)
    except CrkrError:
        return None


def salvaged_trial(body: object, digest: object) -> dict[str, Any]:
    """As `sendable_trial`, for people who want to rescue a trial that no server takes."""
    return salvage(body) if is_intact(body, digest) else {}


def trial_id(trial: dict[str, Any]) -> UUID | None:
    """The trial's id, or None where it cannot be read."""
    value = trial.get("id")
    return UUID(bytes=value) if isinstance(value, bytes) and len(value) == 16 else None


def is_intact(body: object, digest: object) -> TypeGuard[bytes]:
    """Whether a row is still what was written."""
    return isinstance(body, bytes) and digest_of(body) == digest


def digest_of(body: bytes) -> bytes:
    """Digest of a row."""
    return blake2b(body, digest_size=16).digest()
