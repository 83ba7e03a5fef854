"""What a server's access control lets this client do: what is denied meets with silence."""

from __future__ import annotations

from typing import Final

import zenoh

from crkr.client.network.trust import EVERYONE, NotTheServer, Trust
from crkr.protocol import encoding, pack, rpc_key, task_key
from crkr.protocol.keys import admin_key

__all__ = ["allowed", "others"]

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


def others(session: zenoh.Session, task: str) -> set[str]:
    """Zenoh ids of other clients that answer questions to the server; waits for all answers.

    Empty where another router stands in between, which makes the server one of many.
    """
    trust, found, known = Trust(), set(), False
    for key in (rpc_key("info"), task_key(task, "predict"), task_key(task, "report")):
        for reply in _ask(session, key):
            if trust.is_server(session, reply):
                known = True
            elif reply.replier_id is not None:
                found.add(str(reply.replier_id.zid))
    return found if known else set()


def _ask(session: zenoh.Session, key: str) -> zenoh.handlers.Handler[zenoh.Reply]:
    return session.get(
        key,
        zenoh.handlers.FifoChannel(4),
        payload=pack({}),
        encoding=encoding(key.rpartition("/")[2]),
        consolidation=zenoh.ConsolidationMode.NONE,
        target=EVERYONE,
        timeout=_PATIENCE_S,
    )


def _is_answered(session: zenoh.Session, key: str) -> bool | None:
    replies = _ask(session, key)
    try:
        reply = Trust().pick(session, replies)
    except (zenoh.ZError, NotTheServer):
        return False
    late = reply.err is not None and reply.err.payload.to_bytes() == b"Timeout"  # Zenoh's own
    return None if late else True
