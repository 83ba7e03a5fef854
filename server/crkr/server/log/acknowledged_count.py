"""Keeps the number of acknowledged log positions, to detect a database that lost its end.

SQLite drops everything in its write-ahead log behind a damaged byte, as it must after a crash, and a log cut off at a
commit looks complete. So the number is in a separate file, written after each commit and before the answer. The log
reaches the disk first, so the number may lag behind but is never too large.
"""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path
from typing import Final, final
from zlib import crc32

from crkr.protocol import StorageError
from crkr.server.log.data_files import open_data_file

__all__ = ["TALLY_NAME", "Tally", "lost_end", "read_tally"]

logger = logging.getLogger(__name__)

TALLY_NAME: Final = "acknowledged"
_LINE: Final = re.compile(rb"(\d{20}) ([0-9a-f]{8})\n")
_LINE_BYTES: Final = 30


@final
class Tally:
    """The file beside the log; for its one writer.

    Raises:
        StorageError: It cannot be written.
    """

    def __init__(self, directory: Path, positions: int) -> None:
        path = directory / TALLY_NAME
        try:
            self._file = open_data_file(path, os.O_RDWR | os.O_CREAT)
            if os.fstat(self._file).st_nlink > 1:  # the file may be another program's
                os.close(self._file)
                path.unlink()
                self._file = open_data_file(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
            os.pwrite(self._file, _line(positions), 0)
            os.ftruncate(self._file, _LINE_BYTES)
        except OSError as error:
            raise StorageError(f"{path} cannot be written: {error.strerror}") from error

    def note(self, positions: int) -> None:
        """Store the number of log positions of all tasks; if that fails, the stored number lags behind."""
        try:
            os.pwrite(self._file, _line(positions), 0)
        except OSError as error:
            logger.warning("the number of acknowledged log positions was not kept: %s", error.strerror)

    def close(self) -> None:
        """Close the file; a later number is not written."""
        file, self._file = self._file, -1
        os.close(file)


def read_tally(directory: Path) -> int:
    """Number of log positions that were certainly acknowledged; 0 if unknown.

    Raises:
        StorageError: It cannot be read, or is no plain file.
    """
    path = directory / TALLY_NAME
    try:
        file = open_data_file(path, os.O_RDONLY)
        try:
            data = os.read(file, _LINE_BYTES + 1)
        finally:
            os.close(file)
    except FileNotFoundError:
        return 0
    except OSError as error:
        raise StorageError(f"{path} cannot be read: {error.strerror}") from error
    found = _LINE.fullmatch(data)
    if found is None or crc32(found[1]) != int(found[2], 16):
        logger.warning("%s is damaged: it cannot be told whether the log lost its end", path)
        return 0
    return int(found[1])


def lost_end(where: str, held: int, acknowledged: int) -> str:
    """The message about a log that lacks acknowledged entries."""
    return (
        f"the task log {where} holds {held} entries, but {acknowledged} were acknowledged: its end is lost, or it is "
        "an older copy"
    )


def _line(positions: int) -> bytes:
    number = b"%020d" % positions
    return b"%s %08x\n" % (number, crc32(number))
