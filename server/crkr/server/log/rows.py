"""Trials as database rows, and back."""

from __future__ import annotations

from hashlib import blake2b
from typing import Any, Final
from uuid import UUID

import numpy as np

from crkr.protocol import KINDS, StorageError, Trial, pack, unpack
from crkr.server.log.entries import LoggedTrial

__all__ = ["PAGE_COLUMNS", "TRIAL_COLUMNS", "body_digest", "trial_of", "trial_row", "wire_of"]

TRIAL_COLUMNS: Final = "seq, time, id, kind, success, cost, state, goal, outcome, worker, model_version, info, digest"
PAGE_COLUMNS: Final = TRIAL_COLUMNS.replace("digest", "present_cost, removed")


def trial_row(task: int, seq: int, time: float, trial: Trial, digest: bytes) -> tuple[Any, ...]:
    """The row of a new trial: the task, then `TRIAL_COLUMNS`. Numbers are little-endian float64."""
    outcome = None if trial.outcome is None else trial.outcome.astype("<f8").tobytes()
    return (
        task,
        seq,
        time,
        trial.id.bytes,
        KINDS.index(trial.kind),
        trial.success,
        trial.cost,
        trial.state.astype("<f8").tobytes(),
        trial.goal.astype("<f8").tobytes(),
        outcome,
        trial.worker,
        trial.model_version,
        pack(trial.info) if trial.info else None,
        digest,
    )


def trial_of(row: tuple[Any, ...]) -> LoggedTrial:
    """Reads `TRIAL_COLUMNS`.

    Raises:
        StorageError: The content is not what was stored: it does not match its digest.
    """
    seq, time, identity, kind, success, cost, state, goal, outcome, worker, model_version, info, digest = row
    try:
        trial = Trial(
            id=UUID(bytes=identity),
            state=np.frombuffer(state, "<f8"),
            goal=np.frombuffer(goal, "<f8"),
            cost=cost,
            success=bool(success),
            kind=KINDS[kind],
            outcome=None if outcome is None else np.frombuffer(outcome, "<f8"),
            worker=worker,
            model_version=model_version,
            info=unpack(info) if info else {},
        )
        intact = trial.digest() == digest
    except (ValueError, TypeError, IndexError) as error:
        raise StorageError(f"the trial at log position {seq} is damaged: {error}; restore a backup") from error
    if not intact:
        raise StorageError(f"the trial at log position {seq} does not match its digest; restore a backup")
    return LoggedTrial(seq, time, trial)


def _vector(data: bytes) -> dict[str, Any]:
    return {"shape": [len(data) // 8], "dtype": "<f8", "data": data}


def wire_of(row: tuple[Any, ...]) -> dict[str, Any]:
    """Reads `PAGE_COLUMNS` straight into an entry of a `samples` page; no arrays are made on the way."""
    seq, time, identity, kind, success, cost, state, goal, outcome, worker, model_version, info, present, removed = row
    entry: dict[str, Any] = {
        "id": identity,
        "state": _vector(state),
        "goal": _vector(goal),
        "cost": cost if present is None else present,
        "success": bool(success),
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
    if info:
        entry["info"] = unpack(info)
    if removed:
        entry["removed"] = True
    return entry


def body_digest(kind: str, body: bytes) -> bytes:
    """16 bytes that tell whether an event is still what was stored."""
    return blake2b(kind.encode() + b"\0" + body, digest_size=16).digest()
