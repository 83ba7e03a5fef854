"""The file of an outbox: trials in the order they were reported, until the server has them.

One SQLite database for one task, held by one process at a time. A trial is in it when `add` returns, after an fsync;
each row has a digest, so that a trial is never sent otherwise than it was reported. A row that cannot be read is put
aside like a trial that the server refuses.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeGuard, final
from uuid import UUID

from crkr.client.lifetimes import check_not_forked, hold, is_forked, release
from crkr.client.outbox.file_lock import FileLock, file_at, in_use, no_locks
from crkr.protocol import Conflict, CrkrError, Invalid, StorageError, TaskSpec, Trial, Unavailable, pack, unpack
from crkr.protocol.codec import salvage

__all__ = ["OutboxFile", "Refused"]

_APPLICATION: Final = 0x63726B6F  # "crko"; `file` and SQLite tools show it
_SCHEMA: Final = 1
_TABLES: Final = """
CREATE TABLE about (task TEXT NOT NULL, spec BLOB NOT NULL);
CREATE TABLE trial (number INTEGER PRIMARY KEY AUTOINCREMENT, body BLOB NOT NULL, digest BLOB NOT NULL, error TEXT);
"""
_IN_USE: Final = ("SQLITE_BUSY", "SQLITE_LOCKED")
_NO_LOCKS: Final = (
    "SQLITE_PROTOCOL",
    "SQLITE_NOLFS",
    "SQLITE_IOERR_LOCK",
    "SQLITE_IOERR_RDLOCK",
    "SQLITE_IOERR_UNLOCK",
)
_MEANING: Final = ("name", "description", "state", "goal", "outcome")  # fields of a specification


class Refused(NamedTuple):
    """A trial that was put aside: the server does not take it, or the file no longer holds it as it was.

    Attributes:
        number: Its place in the file.
        id: The trial's; None for one that is damaged.
        error: The server's code and words; "STORAGE: ..." for one that cannot be read.
        trial: All of it, as far as it can be read; empty for one that is damaged.
    """

    number: int
    id: UUID | None
    error: str
    trial: dict[str, Any]


@final
class OutboxFile:
    """Trials to be sent; any thread may call it, but no process that was forked meanwhile.

    Args:
        path: Made where it is not there.
        task: The task's name.

    Raises:
        StorageError: It cannot be opened, is none of these files, or is open already.
        Conflict: It belongs to another task.
        Unavailable: This process was forked from one that had a client; so do all methods.
    """

    def __init__(self, path: Path, task: str) -> None:
        check_not_forked()
        self._path, self._task = path.absolute(), task  # a program may change its directory later
        self._lock = threading.Lock()
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
        )  # damaged text is told, not raised
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
        """The file of whatever task; raises `StorageError` where there is none, or it is in use."""
        if not path.is_file():
            raise StorageError(f"there is no outbox {path}")
        try:
            with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0.0)) as database:
                task = database.execute("SELECT task FROM about").fetchone()
        except sqlite3.Error as error:
            if str(getattr(error, "sqlite_errorname", "")).startswith(_IN_USE):
                raise in_use(path) from error
            raise StorageError(f"{path} is no outbox, or it cannot be read: {error}") from error
        if task is None:
            raise StorageError(f"the outbox {path} is empty: it was never given a task")
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
        """Keeps the specification for the next time; returns it."""
        with self._writing("written") as database:
            database.execute("DELETE FROM about")
            database.execute("INSERT INTO about VALUES (?, ?)", (self._task, pack(spec.to_dict())))
        self._spec = spec
        return spec

    def add(self, trials: Sequence[Trial]) -> None:
        """Keeps trials, all or none; they are on the disk when this returns.

        Raises:
            Invalid: One would not be read back as it was given.
            StorageError: They could not be written; none is kept.
        """
        bodies = [_body(trial, self._spec) for trial in trials]
        with self._writing("written") as database:
            database.executemany(
                "INSERT INTO trial (body, digest) VALUES (?, ?)", [(body, _digest(body)) for body in bodies]
            )

    def pending(self) -> int:
        """How many trials are still to be sent."""
        with self._reading() as database:
            return int(database.execute("SELECT count(*) FROM trial WHERE error IS NULL").fetchone()[0])

    def next(self, most: int) -> list[tuple[int, dict[str, Any] | None]]:
        """The first that are to be sent: number, and trial as a message map; None for one that cannot be read."""
        query = "SELECT number, body, digest FROM trial WHERE error IS NULL ORDER BY number LIMIT ?"
        with self._reading() as database:
            rows = database.execute(query, (most,)).fetchall()
        return [(number, _trial(body, digest)) for number, body, digest in rows]

    def why_unreadable(self, number: int) -> str:
        """What is wrong with a row for which `next` has None."""
        with self._reading() as database:
            row = database.execute("SELECT body, digest FROM trial WHERE number = ?", (number,)).fetchone()
        if row is None or not _is_whole(row[0], row[1]):
            return f"trial {number} is damaged in {self._path}: it does not match its digest"
        try:
            unpack(row[0])
        except CrkrError as error:  # a version before kept what no server takes
            return f"trial {number} in {self._path} cannot be sent: {error.message}"
        return f"trial {number} in {self._path} can be read"

    def delivered(self, numbers: Sequence[int]) -> None:
        """Forgets trials that the server has."""
        with self._writing("written") as database:
            database.executemany("DELETE FROM trial WHERE number = ?", [(number,) for number in numbers])

    def refuse(self, number: int, error: str) -> None:
        """Puts a trial aside that the server does not take."""
        with self._writing("written") as database:
            database.execute("UPDATE trial SET error = ? WHERE number = ?", (error, number))

    def refused(self) -> list[Refused]:
        """What was put aside."""
        query = "SELECT number, body, digest, error FROM trial WHERE error IS NOT NULL ORDER BY number"
        with self._reading() as database:
            rows = database.execute(query).fetchall()
        found = [(number, _as_far_as_readable(body, digest), str(error)) for number, body, digest, error in rows]
        return [Refused(number, _id(one), error, one) for number, one, error in found]

    def discard(self, numbers: Sequence[int]) -> None:
        """Forgets trials that were put aside, and no others."""
        with self._writing("written") as database:
            query = "DELETE FROM trial WHERE number = ? AND error IS NOT NULL"
            database.executemany(query, [(number,) for number in numbers])

    def close(self) -> None:
        """Frees the file; in a forked child it does nothing, for SQLite would take the parent's journal away."""
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
        execute("BEGIN IMMEDIATE")  # takes the lock, and keeps it in this mode
        kind, version = (execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version"))
        empty = execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
        if empty:
            for statement in _TABLES.strip().split("\n"):
                execute(statement)
            execute(f"PRAGMA application_id = {_APPLICATION}")
            execute(f"PRAGMA user_version = {_SCHEMA}")
        elif (kind, version) != (_APPLICATION, _SCHEMA):
            raise StorageError(f"{self._path} is no outbox, or one of another version of crkr; choose another file")
        about = execute("SELECT task, spec FROM about").fetchone()
        if about is not None:
            if about[0] != self._task:
                raise Conflict(f"the outbox {self._path} is one of task {about[0]!r}, not {self._task!r}")
            try:
                self._spec = _spec(unpack(about[1]))
            except Invalid as error:
                raise StorageError(
                    f"the specification in the outbox {self._path} cannot be read: {error.message}"
                ) from error
        execute("COMMIT")
        execute("PRAGMA journal_mode = WAL")  # not before it is known to be ours: this changes the file

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        check_not_forked()  # before the lock, which a thread of the parent may have held at the fork
        with self._lock, self._errors("read"):
            self._check_open()
            yield self._database

    @contextmanager
    def _writing(self, what: str) -> Iterator[sqlite3.Connection]:
        check_not_forked()
        with self._lock, self._errors(what):
            self._check_open()
            self._holder.check()
            if file_at(self._path) != self._file:  # what SQLite wrote now would be gone with this process
                raise StorageError(
                    f"the outbox {self._path} was moved, removed or replaced while it was open; put it back, "
                    "or close this outbox and open another"
                )
            if self._database.in_transaction:  # an interrupt came between its beginning and its end
                self._database.execute("ROLLBACK")
            try:
                self._database.execute("BEGIN IMMEDIATE")
                yield self._database
                self._database.execute("COMMIT")
            except BaseException:
                if self._database.in_transaction:
                    self._database.execute("ROLLBACK")
                raise

    def _check_open(self) -> None:
        if self._closed:
            raise Unavailable(f"the outbox {self._path} is closed; open it again")

    @contextmanager
    def _errors(self, what: str) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, sqlite3.Warning) as error:
            if str(getattr(error, "sqlite_errorname", "")).startswith(_IN_USE):
                raise in_use(self._path) from error
            if getattr(error, "sqlite_errorname", "") in _NO_LOCKS:
                raise no_locks(self._path, error) from error
            raise StorageError(f"the outbox {self._path} cannot be {what}: {error}") from error
        except CrkrError:
            raise
        except (TypeError, ValueError, LookupError) as error:
            raise StorageError(f"the outbox {self._path} holds what was never written ({error})") from error


def _body(trial: Trial, spec: TaskSpec | None) -> bytes:
    """A trial's bytes, which are read back as the server will read them: equal, or it is not taken."""
    body = pack(trial.to_wire())
    try:
        message = unpack(body)
        same = spec is None or pack(Trial.from_wire(message, spec).to_wire()) == body
    except Invalid as error:
        where = "its info" if _is_read_without_info(trial) else "it"
        raise Invalid(f"the trial cannot be kept: {where} cannot be read back ({error.message})") from error
    if not same:
        raise Invalid(
            "the trial cannot be kept: it would not be read back as it was given; is all of its info plain data?"
        )
    return body


def _is_read_without_info(trial: Trial) -> bool:
    message = trial.to_wire()
    message.pop("info", None)
    try:
        unpack(pack(message))
    except Invalid:
        return False
    return True


def _spec(fields: dict[str, Any]) -> TaskSpec:
    """The specification; of one whose settings are refused today only what gives the trials their meaning."""
    try:
        return TaskSpec.from_dict(fields)
    except Invalid:
        return TaskSpec.from_dict({name: fields[name] for name in _MEANING if name in fields})


def _trial(body: object, digest: object) -> dict[str, Any] | None:
    """What the row holds, where it is still what was written and can be sent."""
    if not _is_whole(body, digest):
        return None
    try:
        return unpack(body)
    except CrkrError:
        return None


def _as_far_as_readable(body: object, digest: object) -> dict[str, Any]:
    """The same for people, who may want to rescue what no server takes."""
    return salvage(body) if _is_whole(body, digest) else {}


def _id(trial: dict[str, Any]) -> UUID | None:
    value = trial.get("id")
    return UUID(bytes=value) if isinstance(value, bytes) and len(value) == 16 else None


def _is_whole(body: object, digest: object) -> TypeGuard[bytes]:
    return isinstance(body, bytes) and _digest(body) == digest


def _digest(body: bytes) -> bytes:
    return blake2b(body, digest_size=16).digest()
