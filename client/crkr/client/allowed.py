"""What a server's access control lets this client do: denied questions are met with silence."""

from __future__ import annotations

from typing import Final

from crkr.client.rpc import Rpc
from crkr.protocol import CrkrError, Unavailable, rpc_key, task_key
from crkr.protocol.keys import admin_key

__all__ = ["allowed"]

_PATIENCE_S: Final = 0.3


def allowed(rpc: Rpc, task: str) -> dict[str, bool]:
    """Whether each kind of work is let through, on a connection that works.

    Asks with empty messages, which the server refuses as `Invalid` and stores nothing of: any answer is a yes.
    """
    keys = {
        "predict": task_key(task, "predict"),
        "report": task_key(task, "report"),
        "create tasks": rpc_key("create_task"),
        "administer": admin_key(task, "recost"),
    }
    return {work: _is_answered(rpc, key) for work, key in keys.items()}


def _is_answered(rpc: Rpc, key: str) -> bool:
    try:
        rpc.call(key, {}, _PATIENCE_S)
    except Unavailable:
        return False
    except CrkrError:
        return True
    return True
