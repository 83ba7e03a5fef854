"""Trials as columns, read from database rows at a restart."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from typing import Any, Final

import numpy as np

from crkr.learner import TrialColumns
from crkr.protocol import KINDS, Array, CrkrError, StorageError
from crkr.server.log.rows import DIGEST_BYTES

__all__ = ["BLOCK_COLUMNS", "columns_of"]

BLOCK_COLUMNS: Final = "seq, id, kind, success, cost, state, goal, outcome, digest"


def columns_of(rows: Sequence[tuple[Any, ...]], dimensions: int, outputs: int, measured: int) -> TrialColumns:
    """Read rows of `BLOCK_COLUMNS`.

    Args:
        rows: As the database gives them.
        dimensions: d.
        outputs: p.
        measured: q where outcomes are learned from; 0 leaves them out.

    Raises:
        StorageError: A row does not match its digest.
    """
    seqs, ids, kinds, success, costs, states, goals, outcomes, digests = zip(*rows, strict=True)
    try:
        numbers = np.array(costs, dtype="<f8")  # None becomes NaN
        if max(kinds) >= len(KINDS):
            raise ValueError(f"kind {max(kinds)} is unknown")
        digests = tuple([digest[:DIGEST_BYTES] for digest in digests])
        stored = numbers.tobytes()
        for row, digest in enumerate(digests):
            head = bytes((kinds[row], success[row], outcomes[row] is not None, costs[row] is not None))
            content = head + states[row] + goals[row] + stored[8 * row : 8 * row + 8] + (outcomes[row] or b"")
            if blake2b(content, digest_size=16).digest() != digest:
                raise StorageError(f"the trial at log position {seqs[row]} does not match its digest; restore a backup")
        return TrialColumns(
            seqs=np.array(seqs, dtype=np.int64),
            ids=b"".join(ids),
            digests=b"".join(digests),
            states=np.frombuffer(b"".join(states), "<f8").reshape(-1, dimensions),
            goals=np.frombuffer(b"".join(goals), "<f8").reshape(-1, outputs),
            costs=numbers,
            kinds=np.array(kinds, dtype=np.uint8),
            flags=np.array(success, dtype=np.uint8),
            outcomes=_outcomes(outcomes, measured) if measured else None,
        )
    except StorageError:
        raise
    except (ValueError, TypeError, OverflowError, CrkrError) as error:
        raise StorageError(
            f"trials at log positions {seqs[0]} to {seqs[-1]} are damaged: {error}; restore a backup"
        ) from error


def _outcomes(stored: Sequence[bytes | None], measured: int) -> Array:
    absent = np.full(measured, np.nan).tobytes()
    return np.frombuffer(b"".join([absent if one is None else one for one in stored]), "<f8").reshape(-1, measured)
