"""Converts trials to database rows and back; digests prove that a row is unchanged.

A trial's `success` column holds its `flags`. Its `digest` column holds 16 bytes over the content, which identify a
repeated report, and a seal of 8 bytes over those and the rest of the row. Rows of the first schema have no seal.
"""

from __future__ import annotations

import struct
from hashlib import blake2b
from typing import Any, Final
from uuid import UUID

import numpy as np

from crkr.protocol import KINDS, CrkrError, StorageError, Trial, pack, unpack
from crkr.protocol.trial import success_and_learn
from crkr.server.log.entries import LoggedTrial

__all__ = [
    "DIGEST_BYTES",
    "ROW_COLUMNS",
    "TRIAL_COLUMNS",
    "body_digest",
    "changed_digest",
    "check_row",
    "content_digest",
    "trial_of",
    "trial_row",
    "wire_of",
]

DIGEST_BYTES: Final = 16  # of the content
TRIAL_COLUMNS: Final = "seq, time, id, kind, success, cost, state, goal, outcome, worker, model_version, info, digest"
ROW_COLUMNS: Final = f"{TRIAL_COLUMNS}, present_cost, removed"
_SEAL_BYTES: Final = 8


def trial_row(task: int, seq: int, time: float, trial: Trial, digest: bytes) -> tuple[Any, ...]:
    """The row of a new trial: the task, then `TRIAL_COLUMNS`. Numbers are little-endian float64."""
    outcome = None if trial.outcome is None else trial.outcome.astype("<f8").tobytes()
    info = pack(trial.info) if trial.info else None
    return (
        task,
        seq,
        time,
        trial.id.bytes,
        KINDS.index(trial.kind),
        trial.flags,
        trial.cost,
        trial.state.astype("<f8").tobytes(),
        trial.goal.astype("<f8").tobytes(),
        outcome,
        trial.worker,
        trial.model_version,
        info,
        digest + _seal(digest, (seq, time, trial.id.bytes, trial.worker, trial.model_version, info, None, 0)),
    )


def trial_of(row: tuple[Any, ...]) -> LoggedTrial:
    """Read `ROW_COLUMNS`.

    Raises:
        StorageError: The row is not what was stored.
    """
    check_row(row)
    seq, time, identity, kind, success, cost, state, goal, outcome, worker, model_version, info, *_ = row
    try:
        done, learn = success_and_learn(success)
        trial = Trial(
            id=UUID(bytes=identity),
            state=np.frombuffer(state, "<f8"),
            goal=np.frombuffer(goal, "<f8"),
            cost=cost,
            success=done,
            kind=KINDS[kind],
            outcome=None if outcome is None else np.frombuffer(outcome, "<f8"),
            worker=worker,
            model_version=model_version,
            info=unpack(info, depth=None) if info else {},
            learn=learn,
        )
    except (ValueError, TypeError, IndexError, CrkrError) as error:
        raise StorageError(f"the trial at log position {seq} is damaged: {error}; restore a backup") from error
    return LoggedTrial(seq, time, trial)


def wire_of(row: tuple[Any, ...]) -> dict[str, Any]:
    """Read `ROW_COLUMNS` directly into an entry of a `samples` page, without arrays.

    Raises:
        StorageError: The row is not what was stored.
    """
    check_row(row)
    seq, time, identity, kind, success, cost, state, goal, outcome, worker, model_version, info, _, present, gone = row
    done, learn = success_and_learn(success)
    entry: dict[str, Any] = {
        "id": identity,
        "state": _vector(state),
        "goal": _vector(goal),
        "cost": cost if present is None else present,
        "success": done,
        "kind": KINDS[kind],
        "seq": seq,
        "time": time,
    }
    if outcome is not None:
        entry["outcome"] = _vector(outcome)
    if worker is not None:
        entry["worker"] = worker
    if model_version is not None:
        entry["model_version"] = model_version
    if learn is not None:
        entry["learn"] = learn
    if info:
        entry["info"] = unpack(info, depth=None)
    if gone:
        entry["removed"] = True
    return entry


def changed_digest(row: tuple[Any, ...], cost: float | None, removed: bool) -> bytes:
    """The new digest column of a row, read as `ROW_COLUMNS`, for a new current cost and removal mark.

    Raises:
        StorageError: The row is not what was stored.
    """
    check_row(row)
    digest = row[12][:DIGEST_BYTES]
    return bytes(digest + _seal(digest, (*row[:3], *row[9:12], cost, int(removed))))


def content_digest(
    kind: int, success: int, cost: float | None, state: bytes, goal: bytes, outcome: bytes | None
) -> bytes:
    """`Trial.digest` of a row's columns."""
    head = bytes((kind, success, outcome is not None, cost is not None))
    number = struct.pack("<d", float("nan") if cost is None else cost)
    return blake2b(head + state + goal + number + (outcome or b""), digest_size=DIGEST_BYTES).digest()


def body_digest(kind: str, body: bytes) -> bytes:
    """16 bytes that show whether an event is unchanged."""
    return blake2b(kind.encode() + b"\0" + body, digest_size=16).digest()


def check_row(row: tuple[Any, ...]) -> None:
    """Raise `StorageError` for a damaged row of `ROW_COLUMNS`."""
    seq, time, identity, kind, success, cost, state, goal, outcome, worker, version, info, digest, *present = row
    try:
        intact = digest[:DIGEST_BYTES] == content_digest(kind, success, cost, state, goal, outcome)
        if len(digest) != DIGEST_BYTES:
            rest = (seq, time, identity, worker, version, info, *present)
            intact = intact and digest[DIGEST_BYTES:] == _seal(digest[:DIGEST_BYTES], rest)
    except (ValueError, TypeError, OverflowError, struct.error) as error:
        raise StorageError(f"the trial at log position {seq} is damaged: {error}; restore a backup") from error
    if not intact:
        raise StorageError(f"the trial at log position {seq} does not match its digest; restore a backup")


def _seal(digest: bytes, rest: tuple[Any, ...]) -> bytes:
    """`rest` is seq, time, id, worker, model version, info, present cost, removed."""
    return blake2b(digest + pack({"rest": rest}), digest_size=_SEAL_BYTES).digest()


def _vector(data: bytes) -> dict[str, Any]:
    return {"shape": [len(data) // 8], "dtype": "<f8", "data": data}
