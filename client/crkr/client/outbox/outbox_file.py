"""The file of an outbox: trials in the order of their reports, until the server has them.

An SQLite database for one task, open in one process at a time. `add` returns after an fsync. Each row has a digest, so
that a trial is sent exactly as it was reported. An unreadable row is put aside like a trial that the server refuses.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, final
from uuid import UUID

from crkr.client.lifetimes import check_not_forked, hold, is_forked, release
from crkr.client.outbox.file_lock import FileLock, file_at, in_use, no_locks
from crkr.client.outbox.trial_rows import (
    digest_of,
    is_intact,
    packed_trial,
    readable_spec,
    salvaged_trial,
    sendable_trial,
    trial_id,
)
from crkr.protocol import Conflict, CrkrError, Invalid, StorageError, TaskSpec, Trial, Unavailable, pack, unpack
from crkr.protocol.keys import NAME

__all__ = ["OutboxFile", "Refused"]

_APPLICATION: Final = 0x63726B6F  # "crko"; `file` and SQLite tools show it
_SCHEMA: Final = 1
_TABLES: Final = """
CREATE TABLE about (task TEXT NOT NULL, spec BLOB NOT NULL);
CREATE TABLE trial (number INTEGER PRIMARY KEY AUTOINCREMENT, body BLOB NOT NULL, digest BLOB NOT NULL, error TEXT);
"""
_ENTRIES: Final = {"about": "table", "trial": "table"}
_IN_USE: Final = ("SQLITE_BUSY", "SQLITE_LOCKED")
_NO_LOCKS: Final = (
    "SQLITE_PROTOCOL",
    "SQLITE_NOLFS",
    "SQLITE_IOERR_LOCK",
    "SQLITE_IOERR_RDLOCK",
    "SQLITE_IOERR_UNLOCK",
)


class Refused(NamedTuple):
    """A trial that was put aside: the server refused it, or its row is damaged.

    Attributes:
        number: Its number in the file.
        id: The trial's id; None if it is damaged.
        error: The server's code and message; "STORAGE: ..." for an unreadable row.
        trial: The trial as far as it can be read; empty if it is damaged.
    """

    number: int
    id: UUID | None
    error: str
    trial: dict[str, Any]


@final
class OutboxFile:
    """Trials to be sent; threads may share it, forked processes may not.

    Raises:
        StorageError: It cannot be opened, is not an outbox, or is open already.
        Conflict: It belongs to another task.
        Unavailable: This process was forked from one that had a client; all methods raise it then.
    """

    def __init__(self, path: Path, task: str) -> None:
        check_not_forked()
        self._path, self._task = path.absolute(), task  # a program may change its directory later
        self._lock = threading.Lock()
        self._transaction = object()  # the latest
        self._closed = False
        self._spec: TaskSpec | None = None
        self._holder = FileLock(self._path)
        try:
            with self._errors("opened"):
                self._database = sqlite3.connect(self._path, timeout=0.0, isolation_level=None, check_same_thread=False)
        except BaseException:
            self._holder.release()
            raise
        self._database.text_factory = partial(
            str, encoding="utf-8", errors="replace"
        )  # damaged text is shown, not an error
        hold(self, self._database)
        try:
            with self._errors("opened"):
                self._prepare()
            self._file = file_at(self._path)
        except BaseException:
            self.close()
            raise

    @classmethod
    def existing(cls, path: Path) -> OutboxFile:
        """Opens an existing file of any task; raises `StorageError` if it does not exist or is in use."""
        if not path.is_file():
            raise StorageError(f"there is no outbox {path}")
        try:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0.0)) as database:
                task = database.execute("SELECT task FROM about").fetchone()
        except sqlite3.Error as error:
            if _is_locked(error):
                raise in_use(path) from error
            raise StorageError(f"{path} is no outbox, or it cannot be read: {error}") from error
        if task is None:
            raise StorageError(f"the outbox {path} is empty: it was never given a task")
        if not NAME.fullmatch(str(task[0])):
            raise StorageError(f"{path} is no outbox: its task's name is none")
        return cls(path, str(task[0]))

    @property
    def task(self) -> str:
        """The name of its task."""
        return self._task

    @property
    def spec(self) -> TaskSpec | None:
        """The task's specification; None while the file is new."""
        return self._spec

    def describe(self, spec: TaskSpec) -> TaskSpec:
        """Stores the specification and returns it."""
        with self._alone(), self._writing() as database:
            database.execute("DELETE FROM about")
            database.execute("INSERT INTO about VALUES (?, ?)", (self._task, pack(spec.to_dict())))
        self._spec = spec
        return spec

    def add(self, trials: Sequence[Trial]) -> None:
        """Stores trials, all or none; they are on the disk when this returns.

        Raises:
            Invalid: A trial would not be read back as it was given.
            StorageError: They cannot be written; none is stored.
        """
        bodies = [packed_trial(trial, self._spec) for trial in trials]
        with self._alone(), self._writing() as database:
            database.executemany(
                "INSERT INTO trial (body, digest) VALUES (?, ?)", [(body, digest_of(body)) for body in bodies]
            )

    def pending(self) -> int:
        """Number of trials still to be sent."""
        with self._alone(), self._reading() as database:
            return int(database.execute("SELECT count(*) FROM trial WHERE error IS NULL").fetchone()[0])

    def next(self, most: int) -> list[tuple[int, dict[str, Any] | None]]:
        """The first trials to send: number, and trial as a message map (None if it cannot be read)."""
        query = "SELECT number, body, digest FROM trial WHERE error IS NULL ORDER BY number LIMIT ?"
        with self._alone(), self._reading() as database:
            rows = database.execute(query, (most,)).fetchall()
        return [(number, sendable_trial(body, digest)) for number, body, digest in rows]

    def why_unreadable(self, number: int) -> str:
        """What is wrong with a row that `next` gave as None."""
        with self._alone(), self._reading() as database:
            row = database.execute("SELECT body, digest FROM trial WHERE number = ?", (number,)).fetchone()
        if row is None or not is_intact(row[0], row[1]):
            return f"trial {number} is damaged in {self._path}: it does not match its digest"
        try:
            unpack(row[0])
        except CrkrError as error:  # an earlier version stored what no server takes
            return f"trial {number} in {self._path} cannot be sent: {error.message}"
        return f"trial {number} in {self._path} can be read"

    def delivered(self, numbers: Sequence[int]) -> None:
        """Deletes trials that the server has."""
        with self._alone(), self._writing() as database:
            database.executemany("DELETE FROM trial WHERE number = ?", [(number,) for number in numbers])

    def refuse(self, number: int, error: str) -> None:
        """Puts a trial aside."""
        with self._alone(), self._writing() as database:
            database.execute("UPDATE trial SET error = ? WHERE number = ?", (error, number))

    def refused(self) -> list[Refused]:
        """The trials that were put aside."""
        query = "SELECT number, body, digest, error FROM trial WHERE error IS NOT NULL ORDER BY number"
        with self._alone(), self._reading() as database:
            rows = database.execute(query).fetchall()
        found = [(number, salvaged_trial(body, digest), str(error)) for number, body, digest, error in rows]
        return [Refused(number, trial_id(one), error, one) for number, one, error in found]

    def discard(self, numbers: Sequence[int]) -> None:
        """Deletes trials that were put aside, and no others."""
        with self._alone(), self._writing() as database:
            query = "DELETE FROM trial WHERE number = ? AND error IS NOT NULL"
            database.executemany(query, [(number,) for number in numbers])

    def close(self) -> None:
        """Closes the file; in a forked child it does nothing, since SQLite would delete the parent's journal."""
        if is_forked():
            return
        with self._lock:
            self._closed = True
            self._database.close()
            self._holder.release()
        release(self)

    def _prepare(self) -> None:
        execute = self._database.execute
        execute("PRAGMA locking_mode = EXCLUSIVE")
        execute("PRAGMA synchronous = FULL")
        execute("BEGIN IMMEDIATE")  # takes the lock; this mode keeps it
        kind, version = (execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
        entries = dict(execute("SELECT name, type FROM sqlite_master WHERE name NOT LIKE 'sqlite!_%' ESCAPE '!'"))
        if not entries:
            for statement in _TABLES.strip().split("\n"):
                execute(statement)
            execute(f"PRAGMA application_id = {_APPLICATION}")
            execute(f"PRAGMA user_version = {_SCHEMA}")
        elif (kind, version, entries) != (_APPLICATION, _SCHEMA, _ENTRIES):  # a trigger might undo what is written
            raise StorageError(f"{self._path} is no outbox, or one of another version of crkr; choose another file")
        about = execute("SELECT task, spec FROM about").fetchone()
        if about is not None:
            if about[0] != self._task:
                raise Conflict(f"the outbox {self._path} is one of task {about[0]!r}, not {self._task!r}")
            try:
                self._spec = readable_spec(unpack(about[1]))
            except Invalid as error:
                raise StorageError(
                    f"the specification in the outbox {self._path} cannot be read: {error.message}"
                ) from error
        execute("COMMIT")
        execute("PRAGMA journal_mode = WAL")  # changes the file, so only after it is known to be ours

    def _alone(self) -> threading.Lock:
        """The lock, for a `with` of the method itself: in a generator an interrupt would leave it held."""
        check_not_forked()  # before the lock, which a parent's thread may have held at the fork
        return self._lock

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._errors("read"):
            self._check_open()
            self._roll_back(self._transaction)
            yield self._database

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        with self._errors("written"):
            self._check_open()
            self._holder.check()
            if file_at(self._path) != self._file:  # SQLite would write to a file without a name
                raise StorageError(
                    f"the outbox {self._path} was moved, removed or replaced while it was open; put it back, "
                    "or close this outbox and open another"
                )
            self._roll_back(self._transaction)
            self._transaction = mine = object()
            try:
                self._database.execute("BEGIN IMMEDIATE")
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                self._roll_back(mine)
                raise

    def _roll_back(self, transaction: object) -> None:
        """Ends a transaction if it is the latest: an interrupted generator may be closed after the next one began."""
        if transaction is self._transaction and self._database.in_transaction:
            self._database.execute("ROLLBACK")

    def _check_open(self) -> None:
        if self._closed:
            raise Unavailable(f"the outbox {self._path} is closed; open it again")

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, sqlite3.Warning) as error:
            if _is_locked(error):
                raise in_use(self._path) from error
            if getattr(error, "sqlite_errorname", "") in _NO_LOCKS:
                raise no_locks(self._path, error) from error
            raise StorageError(f"the outbox {self._path} cannot be {what}: {error}") from error
        except CrkrError:
            raise
        except (TypeError, ValueError, LookupError) as error:
            raise StorageError(f"the outbox {self._path} holds data that was never written ({error})") from error


def _is_locked(error: Exception) -> bool:
    """Whether another has the database; Python 3.10 tells it by words only."""
    return str(getattr(error, "sqlite_errorname", "")).startswith(_IN_USE) or str(error) == "database is locked"
