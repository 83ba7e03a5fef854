"""Opens files of a data directory, which an attacker may have prepared: plain files only, never links.

A symbolic link would get its target overwritten, a fifo would block the start forever, and a database with two names
would have two write-ahead logs. Network file systems cannot hold a task log: they lack locks or shared memory.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from crkr.protocol import StorageError

__all__ = [
    "LOCAL_DISK",
    "NO_LOCKS",
    "check_database_files",
    "cut_short",
    "file_sizes",
    "file_system_of",
    "identities",
    "identity",
    "is_remote",
    "on_file_system",
    "open_data_file",
]

LOCAL_DISK: Final = "keep the data directory on a disk of the machine that runs the server"
# Errors of a lock where the file system, or its server, has no locks.
NO_LOCKS: Final = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
_REMOTE: Final = ("nfs", "cifs", "smb", "lustre", "9p", "ceph", "gpfs", "beegfs", "afs", "fuse.", "virtiofs", "ncpfs")
_MOUNTS: Final = Path("/proc/self/mountinfo")
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
    """Opens a plain file; creates it if `flags` say so.

    Raises:
        StorageError: It is not a plain file.
        OSError: It cannot be opened.
    """
    safe = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC  # opening a fifo or a device must not block
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
    """Check a database and SQLite's files beside it; missing ones are fine.

    Raises:
        StorageError: One is not a plain file, or one to be written has another name elsewhere.
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
    """Device and inode of a file; None if it does not exist."""
    try:
        found = os.lstat(path)
    except OSError:
        return None
    return found.st_dev, found.st_ino


def identities(path: Path) -> dict[str, tuple[int, int] | None]:
    """Device and inode of each file of a database in use."""
    return {name: identity(name) for name in (f"{path}{suffix}" for suffix in _IN_USE)}


def file_sizes(names: Iterable[str]) -> dict[str, int]:
    """Bytes of each file; of a missing one 0."""
    sizes = {}
    for name in names:
        try:
            sizes[name] = os.stat(name).st_size
        except OSError:
            sizes[name] = 0
    return sizes


def cut_short(before: dict[str, int], now: dict[str, int]) -> list[str]:
    """Files that have become shorter, which SQLite's own writing never makes them."""
    return [name for name, size in now.items() if size < before.get(name, 0)]


def _refuse_other_kinds(path: Path, mode: int) -> None:
    if stat.S_ISREG(mode):
        return
    kind = next((name for matches, name in _KINDS if matches(mode)), "something else")
    advice = "; to keep the log elsewhere, give that directory as --data" if stat.S_ISLNK(mode) else ""
    raise StorageError(f"{path} is {kind}, not a plain file; remove it{advice}")


def file_system_of(path: Path) -> str | None:
    """The type of the file system that holds a path, such as "ext4" or "nfs4"; None if unknown."""
    where = os.path.realpath(path)
    try:
        lines = _MOUNTS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    best, kind = "", None
    for line in lines:
        mount, separator, source = line.partition(" - ")
        words, about = mount.split(" "), source.split(" ")
        if not separator or len(words) < 5:
            continue
        point = words[4].encode().decode("unicode_escape") if "\\" in words[4] else words[4]  # \040 is a space
        inside = where == point or where.startswith(point.rstrip("/") + "/")
        if inside and len(point) >= len(best):  # the last mount at a place lies on top
            best, kind = point, about[0]
    return kind


def is_remote(kind: str | None) -> bool:
    """Whether a type is a network file system."""
    return kind is not None and kind.startswith(_REMOTE)


def on_file_system(path: Path) -> str:
    """The file system in brackets, for messages; "" if unknown."""
    kind = file_system_of(path)
    return "" if kind is None else f" (file system {kind})"
