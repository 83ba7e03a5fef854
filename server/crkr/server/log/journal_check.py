"""Detects journals that belong to another database than the one beside them; SQLite would apply them.

Their pages would replace those of the log. A write-ahead log is checked by the tasks' creations, which never change:
the database at its last checkpoint and with its write-ahead log must agree on all that both hold. crkr has a rollback
journal only for a moment, when a new or restored database gets its write-ahead log, which changes only numbers in the
first page.
"""

from __future__ import annotations

import os
import sqlite3
import struct
from pathlib import Path
from typing import Any, Final

from crkr.protocol import StorageError
from crkr.server.log.data_files import open_data_file

__all__ = ["refuse_foreign_journal", "refuse_foreign_wal"]

_MAGIC: Final = bytes.fromhex("d9d505f920a163d7")
_HEAD: Final = struct.Struct(">8s5I")  # magic, records, nonce, pages of the database, bytes a sector, bytes a page
_LARGEST_PAGE: Final = 65536
# Bytes of the first page that such a change writes: format, counter of changes, and by whom and when.
_CHANGING: Final = (slice(18, 20), slice(24, 28), slice(92, 100))

_CREATIONS: Final = (
    "SELECT task.id, event.time, event.digest FROM task JOIN event ON event.task = task.id AND event.seq = 1"
)


def refuse_foreign_wal(connection: sqlite3.Connection, path: Path) -> None:
    """Compares the view of `connection` with the file alone.

    Raises:
        StorageError: The write-ahead log is another database's.
    """
    beside = path.with_name(f"{path.name}-wal")
    # A server that empties its write-ahead log at this moment may show the file half old, half new: look twice.
    if all(_contradicts(connection, path, beside) for _ in range(2)):
        raise StorageError(
            f"{beside} belongs to another database than {path}: together they are no log; restore a backup, or bring "
            "the two files that belong together"
        )


def refuse_foreign_journal(path: Path) -> bool:
    """Checks the rollback journal beside a database; returns whether SQLite has to apply it.

    Raises:
        StorageError: It belongs to another database, or to a change that crkr does not make.
    """
    beside = path.with_name(f"{path.name}-journal")
    try:
        journal, first, size = _start(beside), _start(path), path.stat().st_size
    except FileNotFoundError:
        return False
    except OSError as error:
        raise StorageError(f"{beside} cannot be read: {error.strerror}") from error
    if len(journal) < _HEAD.size or not journal.startswith(_MAGIC):  # SQLite ignores it
        return bool(journal)
    _, _, _, pages, sector, page_size = _HEAD.unpack_from(journal)
    page_size = page_size or 1
    body = journal[sector:]
    held = size // page_size
    ours = (pages == held or max(pages, held) <= 1) and len(body) < 2 * (page_size + 8)
    if ours and len(body) >= page_size + 4:
        ours = body[:4] == b"\0\0\0\1" and _same(body[4 : 4 + page_size], first[:page_size])
    if not ours:
        raise StorageError(
            f"{beside} belongs to another database than {path}, or to a change that no crkr made; restore a backup "
            "into an empty directory"
        )
    return True


def _start(path: Path) -> bytes:
    """The start of a file, a little more than any journal of ours holds."""
    file = open_data_file(path, os.O_RDONLY)
    try:
        return os.read(file, 4 * _LARGEST_PAGE)
    finally:
        os.close(file)


def _same(one: bytes, other: bytes) -> bool:
    """Whether two first pages of a database differ only in what a new write-ahead log changes."""
    pages = [bytearray(one), bytearray(other)]
    for page in pages:
        for part in _CHANGING:
            page[part] = bytes(part.stop - part.start)
    return pages[0] == pages[1]


def _contradicts(connection: sqlite3.Connection, path: Path, beside: Path) -> bool:
    try:
        if not beside.stat().st_size:
            return False
    except OSError:
        return False
    whole = _read(connection)
    return any(whole.get(task, made) != made for task, made in _alone(path).items())


def _alone(path: Path) -> dict[int, tuple[Any, ...]]:
    """Creation events in the file without its write-ahead log; empty if it cannot be read so."""
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
