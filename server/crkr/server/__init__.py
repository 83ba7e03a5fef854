"""The policy service: takes queries, keeps the task log, learns, and says so."""

from __future__ import annotations

from crkr.server.log import SqliteLog, TaskLog
from crkr.server.server import Server, ServerSettings

__all__ = ["Server", "ServerSettings", "SqliteLog", "TaskLog"]
