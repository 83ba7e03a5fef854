"""A write-ahead log that was left beside another database: SQLite takes it for that database's own.

Its pages would replace those of the log. What tells: a task's creation never changes, so the database as its last
checkpoint left it and the database with its write-ahead log must agree on every creation that both hold.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any, Final

from crkr.protocol import StorageError

__all__ = ["refuse_foreign_wal"]

_CREATIONS: Final = (
    "SELECT task.id, event.time, event.digest FROM task JOIN event ON event.task = task.id AND event.seq = 1"
)


def refuse_foreign_wal(connection: sqlite3.Connection, path: Path) -> None:
    """Compares what `connection` reads with the file alone.

    Raises:
        StorageError: The write-ahead log is another database's.
    """
    beside = path.with_name(f"{path.name}-wal")
    # A server that empties its write-ahead log just now may let the file be read half old, half new: look twice.
    if all(_contradicts(connection, path, beside) for _ in range(2)):
        raise StorageError(
            f"{beside} belongs to another database than {path}: together they are no log; restore a backup, or bring "
            "the two files that belong together"
        )


def _contradicts(connection: sqlite3.Connection, path: Path, beside: Path) -> bool:
    try:
        if not beside.stat().st_size:
            return False
    except OSError:
        return False
    whole = _read(connection)
    return any(whole.get(task, made) != made for task, made in _alone(path).items())


def _alone(path: Path) -> dict[int, tuple[Any, ...]]:
    """Creations of the file without its write-ahead log; none where it cannot be read so."""
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        try:
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            return _read(connection) if {"task", "event"} <= tables else {}
        finally:
            connection.close()
    except sqlite3.Error:
        return {}


def _read(connection: sqlite3.Connection) -> dict[int, tuple[Any, ...]]:
    return {task: made for task, *made in connection.execute(_CREATIONS)}
