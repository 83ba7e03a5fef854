"""Key expressions of protocol version 1, and the names they may contain.

`@v1` is written literally: Zenoh's wildcards do not match a chunk that starts with `@`.
"""

from __future__ import annotations

import re
from typing import Final

from crkr.protocol.errors import Invalid, shown

__all__ = [
    "ADMIN_VERBS",
    "PROTOCOL_VERSION",
    "SERVER_VERBS",
    "TASK_VERBS",
    "admin_key",
    "check_name",
    "claim_role_key",
    "claim_worker_key",
    "left_worker_key",
    "live_peer_key",
    "live_role_key",
    "live_server_key",
    "live_worker_key",
    "pub_key",
    "rpc_key",
    "split_key",
    "task_key",
]

PROTOCOL_VERSION: Final = 1
ROOT: Final = f"crkr/@v{PROTOCOL_VERSION}"
SERVER_VERBS: Final = ("info", "tasks", "create_task")
TASK_VERBS: Final = ("predict", "report", "status", "spec", "model", "samples", "explain")
ADMIN_VERBS: Final = (
    "recost", "remove", "amend", "undo", "refit", "configure", "rollback", "rename", "archive", "delete",
)  # fmt: skip
NAME: Final = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")


def check_name(name: object, what: str = "task name") -> str:
    """Returns `name` if a key may contain it.

    Raises:
        Invalid: It is not 1 to 63 of a-z, 0-9 and '-', starting with a letter or digit.
    """
    if not isinstance(name, str) or NAME.fullmatch(name) is None:
        raise Invalid(
            f"{what} must be 1 to 63 characters of a-z, 0-9 and '-', starting with a letter or digit; got {shown(name)}"
        )
    return name


def rpc_key(verb: str) -> str:
    """Key of a server-wide query, e.g. info."""
    return f"{ROOT}/rpc/{verb}"


def task_key(task: str, verb: str) -> str:
    """Key of a task's query, e.g. predict."""
    return f"{ROOT}/task/{task}/rpc/{verb}"


def admin_key(task: str, verb: str) -> str:
    """Key of a task's administration, e.g. recost; its own prefix lets an ACL deny it."""
    return f"{ROOT}/task/{task}/admin/{verb}"


def pub_key(task: str, topic: str) -> str:
    """Key of a task's publications: topic is model, trial or evaluation."""
    return f"{ROOT}/task/{task}/pub/{topic}"


def live_server_key(server_id: str) -> str:
    """Key of a server's liveliness token."""
    return f"{ROOT}/live/server/{server_id}"


def live_peer_key(server: str) -> str:
    """Key of the token that shows a server to those it shares tasks with; `server` is its Zenoh id."""
    return f"{ROOT}/live/peer/{server}"


def live_worker_key(task: str, worker_id: str) -> str:
    """Key of a worker's liveliness token."""
    return f"{ROOT}/task/{task}/live/worker/{worker_id}"


def left_worker_key(task: str, worker_id: str) -> str:
    """Key of the token that shows that a worker left in order; held while it withdraws its own."""
    return f"{ROOT}/task/{task}/live/left/{worker_id}"


def claim_worker_key(task: str, worker_id: str, claim: str) -> str:
    """Key of a process's claim on a worker's id; processes that claim it at the same time see each other's tokens."""
    return f"{ROOT}/task/{task}/live/claim/{worker_id}/{claim}"


def live_role_key(task: str, role: str, holder: str) -> str:
    """Key of the token of the one process that holds a role in a task, such as judging it."""
    return f"{ROOT}/task/{task}/live/role/{role}/{holder}"


def claim_role_key(task: str, role: str, claim: str) -> str:
    """Key of a process's claim on a role, as for a worker's id."""
    return f"{ROOT}/task/{task}/live/claim/role/{role}/{claim}"


def split_key(key: str) -> tuple[str, str, str]:
    """Splits a query's key into (scope, task, verb); scope is "rpc", "task" or "admin", task "" for "rpc".

    Raises:
        Invalid: The protocol has no such key.
    """
    match key.removeprefix(f"{ROOT}/").split("/"):
        case ["rpc", verb]:
            return "rpc", "", verb
        case ["task", task, "rpc", verb]:
            return "task", task, verb
        case ["task", task, "admin", verb]:
            return "admin", task, verb
    raise Invalid(f"key {shown(key)} is not one of protocol version {PROTOCOL_VERSION}")
