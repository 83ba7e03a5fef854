"""Advisory locks that give a data directory to one server; the kernel frees them when the process dies.

Both the directory and the file `lock` in it are locked: the directory cannot be removed unnoticed while its log is in
use, and servers before 0.2 check the file only. If the file is removed while the server runs, it is created and locked
again.
"""

from __future__ import annotations

import errno
import fcntl
import logging
import os
import stat
from contextlib import ExitStack
from pathlib import Path
from typing import Final, final

from crkr.protocol import StorageError
from crkr.server.log.data_files import LOCAL_DISK, NO_LOCKS, identity, on_file_system, open_data_file

__all__ = ["DirectoryLock"]

logger = logging.getLogger(__name__)

_NAME: Final = "lock"
_FAR: Final = 2**40  # beyond the end of the file
# Error of NFS, which cannot lock a directory exclusively; the file is locked there.
_FILES_ONLY: Final = (errno.EBADF, errno.EINVAL, errno.EISDIR)


@final
class DirectoryLock:
    """Holds `directory` until `release`.

    Raises:
        StorageError: Another process holds it (the message names it), it cannot be written, or its file system has no
            locks.
    """

    def __init__(self, directory: Path) -> None:
        self._path, self._lock = directory, directory / _NAME
        self._name = str(self._lock)
        with ExitStack() as undo:
            try:
                directory.mkdir(parents=True, exist_ok=True)
                self._directory = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            except OSError as error:
                raise StorageError(f"data directory {directory} cannot be written: {error.strerror}") from error
            undo.callback(os.close, self._directory)
            if os.fstat(self._directory).st_mode & (stat.S_IWOTH | stat.S_ISVTX) == stat.S_IWOTH:
                logger.warning("data directory %s may be changed by every user of this machine: chmod o-w", directory)
            self._hold(self._directory, files_only=_FILES_ONLY)
            self._file = self._locked_file()
            undo.pop_all()
        self._locked = identity(self._lock)

    def check(self) -> None:
        """Check that the lock file is still the locked one.

        Raises:
            StorageError: It was replaced, and another process holds the new one.
        """
        if self._locked is not None and identity(self._name) == self._locked:
            return
        before, self._file = self._file, self._locked_file()
        os.close(before)
        self._locked = identity(self._lock)
        logger.warning("%s was removed while the server runs, and is made again: leave it there", self._lock)

    def release(self) -> None:
        """Unlock. The file stays; it means nothing by itself."""
        os.close(self._file)
        os.close(self._directory)

    def _locked_file(self) -> int:
        while True:
            try:
                file = open_data_file(self._lock, os.O_RDWR | os.O_CREAT)
            except OSError as error:
                raise StorageError(f"{self._lock} cannot be written: {error.strerror}") from error
            try:
                self._hold(file)
                opened = os.fstat(file)
                if identity(self._lock) != (opened.st_dev, opened.st_ino):  # removed just now
                    os.close(file)
                    continue
                if opened.st_nlink == 1:  # else the file may be another program's
                    os.ftruncate(file, 0)
                    os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
            except StorageError:
                os.close(file)
                raise
            except OSError as error:
                os.close(file)
                raise StorageError(f"{self._lock} cannot be written: {error.strerror}") from error
            return file

    def _hold(self, file: int, files_only: tuple[int, ...] = ()) -> None:
        try:
            if not files_only:
                _try_record_lock(file)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StorageError(
                f"data directory {self._path} is in use by {self._holder()}; stop that server or choose another --data"
            ) from error
        except OSError as error:
            if error.errno in files_only:
                return
            lacking = f"{on_file_system(self._path)}; {LOCAL_DISK}" if error.errno in NO_LOCKS else ""
            raise StorageError(f"data directory {self._path} cannot be locked: {error.strerror}{lacking}") from error

    def _holder(self) -> str:
        try:
            file = open_data_file(self._lock, os.O_RDONLY)
        except (OSError, StorageError):
            return "another process"
        try:
            holder = os.read(file, 32).strip()
        finally:
            os.close(file)
        return f"process {holder.decode()}" if holder.isdigit() else "another process"


def _try_record_lock(file: int) -> None:
    """Take and release a lock on one byte, as SQLite does, which itself takes `ENOLCK` for a busy database."""
    try:
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _FAR)
        fcntl.lockf(file, fcntl.LOCK_UN, 1, _FAR)
    except OSError as error:
        if error.errno in NO_LOCKS:
            raise
