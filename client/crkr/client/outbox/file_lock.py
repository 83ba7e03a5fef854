"""A lock on an outbox's file that lasts as long as its holder.

SQLite uses POSIX locks, which a process loses as soon as it opens and closes the file in any other way, e.g. to copy
it. This lock (flock) belongs to an open file beside the database; the kernel frees it when the holder's process ends.
"""

from __future__ import annotations

import importlib
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, final

from crkr.client.lifetimes import leave_in_child, stay
from crkr.protocol import StorageError

__all__ = ["FileLock", "file_at", "in_use", "no_locks"]

# Without POSIX, SQLite's own locks suffice: a process does not lose them there.
fcntl: Any = importlib.import_module("fcntl") if os.name == "posix" else None


@final
class FileLock:
    """Held from construction to `release`, by one holder in one process.

    Args:
        path: The protected file; the lock is beside it, or beside the target of a symbolic link.

    Raises:
        StorageError: Another holder has it, or the file system has no locks.
    """

    def __init__(self, path: Path) -> None:
        self._protected = path
        self._path: Final = Path(f"{os.path.realpath(path)}.lock")
        self._file: int | None = None
        while self._file is None:
            file = self._open()
            try:
                self._lock(file)
            except BaseException:
                os.close(file)
                raise
            if file_at(self._path) == _identity(os.fstat(file)):
                self._file = file
            else:  # its holder removed it between the two steps
                os.close(file)
        self._identity = _identity(os.fstat(self._file))
        with suppress(OSError):  # for people only; the database reports a full disk
            os.ftruncate(self._file, 0)
            os.write(self._file, f"{os.getpid()}\n".encode())
        leave_in_child(self._file)

    def check(self) -> None:
        """Raises `StorageError` where the lock's file was removed or replaced: there may be a second holder."""
        if file_at(self._path) != self._identity:
            raise StorageError(
                f"the lock of the outbox {self._protected} was removed while it was open ({self._path.name}), and "
                "another process may have opened it; close this outbox and open it again"
            )

    def release(self) -> None:
        """Releases the lock and removes its file; a second call does nothing."""
        file, self._file = self._file, None
        if file is None:
            return
        stay(file)
        if file_at(self._path) == self._identity:
            with suppress(OSError):
                self._path.unlink()
        if fcntl is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough where a forked child has the file open
        os.close(file)

    def _open(self) -> int:
        try:
            return os.open(self._path, os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0), 0o644)
        except OSError as error:
            raise StorageError(
                f"the outbox {self._protected} cannot be opened: {self._path} cannot be made: {error.strerror}"
            ) from error

    def _lock(self, file: int) -> None:
        if fcntl is None:
            return
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise in_use(self._protected, os.pread(file, 32, 0).decode("ascii", "replace").strip()) from error
        except OSError as error:
            raise no_locks(self._protected, error) from error


def in_use(path: Path, holder: str = "") -> StorageError:
    """The error for a file that is open elsewhere."""
    named = f" (process {holder})" if holder else ""
    return StorageError(
        f"the outbox {path} is in use already, by this program or another{named}; "
        "close it there, or choose another file"
    )


def no_locks(path: Path, error: Exception) -> StorageError:
    """The error for a file system without locks, such as some NFS and Lustre."""
    return StorageError(
        f"the outbox {path} cannot be locked: the file system there has no file locks ({error}); "
        "put it on a disk of this machine"
    )


def file_at(path: Path) -> tuple[int, int] | None:
    """Identity of the file at a path, or None."""
    try:
        return _identity(os.stat(path))
    except OSError:
        return None


def _identity(found: os.stat_result) -> tuple[int, int]:
    return found.st_dev, found.st_ino
