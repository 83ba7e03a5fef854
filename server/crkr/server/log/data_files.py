"""Files of a data directory, opened without trust in those who prepared it: plain files only, and no link is followed.

A symbolic link would have its target written over, a fifo would hold the start up for ever, and a database under two
names would have two write-ahead logs.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Final

from crkr.protocol import StorageError

__all__ = ["check_database_files", "identities", "identity", "open_data_file"]

_IN_USE: Final = ("", "-wal", "-shm")  # suffixes of the files that SQLite holds open while a log is in use
_SUFFIXES: Final = (*_IN_USE, "-journal")
_KINDS: Final = (
    (stat.S_ISLNK, "a symbolic link"),
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a fifo"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_data_file(path: Path, flags: int) -> int:
    """A descriptor of a plain file, which is made where `flags` say so.

    Raises:
        StorageError: Something else stands under its name.
        OSError: It cannot be opened.
    """
    safe = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC  # a fifo or a device is opened without a wait
    try:
        file = os.open(path, flags | safe, 0o644)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK, errno.EISDIR, errno.ENXIO, errno.ENODEV, errno.ENOTDIR):
            _refuse_other_kinds(path, os.lstat(path).st_mode)
        raise
    try:
        _refuse_other_kinds(path, os.fstat(file).st_mode)
    except StorageError:
        os.close(file)
        raise
    return file


def check_database_files(path: Path, *, writing: bool = False) -> None:
    """Looks at a database and at SQLite's files beside it; those that are not there are all right.

    Raises:
        StorageError: One is no plain file, or it is to be written and has another name elsewhere.
    """
    for suffix in _SUFFIXES:
        beside = path.with_name(path.name + suffix)
        try:
            found = os.lstat(beside)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise StorageError(f"{beside} cannot be looked at: {error.strerror}") from error
        _refuse_other_kinds(beside, found.st_mode)
        if writing and found.st_nlink > 1:
            raise StorageError(
                f"{beside} has {found.st_nlink} names (hard links), and a server under another one would damage it; "
                "copy it to a file of its own"
            )


def identity(path: Path | str) -> tuple[int, int] | None:
    """Which file stands under a name, by device and inode; None where there is none."""
    try:
        found = os.lstat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def identities(path: Path) -> dict[str, tuple[int, int] | None]:
    """Which files stand under the names of a database in use."""
    return {name: identity(name) for name in (f"{path}{suffix}" for suffix in _IN_USE)}


def _refuse_other_kinds(path: Path, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    kind = next((name for matches, name in _KINDS if matches(mode)), "something else")
    advice = "; to keep the log elsewhere, give that directory as --data" if stat.S_ISLNK(mode) else ""
    raise StorageError(f"{path} is {kind}, not a plain file; remove it{advice}")
