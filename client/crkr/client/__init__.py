"""The Python client: `Client`, `Task`, and the frame of the `crkr` command.

Names are bound when they are first used, so that the command can set up its process before numpy is imported.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from crkr.client.aio import AsyncClient, AsyncSubscription, AsyncTask
    from crkr.client.client import Client, TaskSummary
    from crkr.client.network.presence import Presence
    from crkr.client.network.role import Role
    from crkr.client.network.subscription import Subscription
    from crkr.client.outbox.outbox import Outbox
    from crkr.client.policy import AsyncPolicy, Policy
    from crkr.client.task import Task
    from crkr.client.transport import Transport

__all__ = [
    "AsyncClient",
    "AsyncPolicy",
    "AsyncSubscription",
    "AsyncTask",
    "Client",
    "Outbox",
    "Policy",
    "Presence",
    "Role",
    "Subscription",
    "Task",
    "TaskSummary",
    "Transport",
]

_HOME = {
    "AsyncClient": "aio",
    "AsyncPolicy": "policy",
    "AsyncSubscription": "aio",
    "AsyncTask": "aio",
    "Client": "client",
    "Outbox": "outbox.outbox",
    "Policy": "policy",
    "Presence": "network.presence",
    "Role": "network.role",
    "Subscription": "network.subscription",
    "Task": "task",
    "TaskSummary": "client",
    "Transport": "transport",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
