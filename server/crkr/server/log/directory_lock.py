"""One server a data directory: an advisory lock that the kernel frees when its holder dies."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import final

from crkr.protocol import StorageError

__all__ = ["DirectoryLock"]


@final
class DirectoryLock:
    """Holds `directory` until `release`.

    Raises:
        StorageError: Another process holds it (the message names it), or the directory cannot be written.
    """

    def __init__(self, directory: Path) -> None:
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._file = os.open(directory / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StorageError(f"data directory {directory} cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)
        except BlockingIOError as error:
            holder = os.read(self._file, 32).decode(errors="replace").strip() or "unknown"
            os.close(self._file)
            raise StorageError(
                f"data directory {directory} is in use by process {holder}; stop that server or choose another --data"
            ) from error
        except OSError as error:
            os.close(self._file)
            raise StorageError(f"data directory {directory} cannot be locked: {error.strerror}") from error

    def release(self) -> None:
        """Lets go; the file stays, it means nothing by itself."""
        os.close(self._file)
