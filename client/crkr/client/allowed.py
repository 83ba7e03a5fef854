"""What a server's access control lets this client do: what is denied meets with silence."""

from __future__ import annotations

from typing import Final

import zenoh

from crkr.protocol import encoding, pack, rpc_key, task_key
from crkr.protocol.keys import admin_key

__all__ = ["allowed"]

_PATIENCE_S: Final = 2.0


def allowed(session: zenoh.Session, task: str) -> dict[str, bool | None]:
    """Whether each kind of work is let through, on a connection that works; None: no answer in time.

    Asks with empty messages, which the server refuses as `Invalid` and stores nothing of: any answer is a yes.
    """
    keys = {
        "predict": task_key(task, "predict"),
        "report": task_key(task, "report"),
        "create tasks": rpc_key("create_task"),
        "administer": admin_key(task, "recost"),
    }
    return {work: _is_answered(session, key) for work, key in keys.items()}


def _is_answered(session: zenoh.Session, key: str) -> bool | None:
    replies = session.get(
        key,
        zenoh.handlers.FifoChannel(4),
        payload=pack({}),
        encoding=encoding(key.rpartition("/")[2]),
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=_PATIENCE_S,
    )
    for reply in replies:
        late = reply.err is not None and reply.err.payload.to_bytes() == b"Timeout"  # Zenoh's own
        return None if late else True
    return False
