"""The task log: every event of every task, stored before it is acknowledged. All other state is derived from it."""

from __future__ import annotations

from crkr.server.log.access import read_log
from crkr.server.log.corrections import CORRECTIONS, Corrections, Visible, values_of
from crkr.server.log.entries import DELETED, EVENT_KINDS, Event, LoggedTrial, PendingReport, Stored
from crkr.server.log.reader import LogReader
from crkr.server.log.sqlite_log import SqliteLog
from crkr.server.log.task_log import TaskLog

__all__ = [
    "CORRECTIONS",
    "DELETED",
    "EVENT_KINDS",
    "Corrections",
    "Event",
    "LogReader",
    "LoggedTrial",
    "PendingReport",
    "SqliteLog",
    "Stored",
    "TaskLog",
    "Visible",
    "read_log",
    "values_of",
]
