"""File systems that cannot hold a task log: those of a network, which lack locks or memory shared between processes."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Final

__all__ = ["LOCAL_DISK", "NO_LOCKS", "file_system_of", "is_remote", "on_file_system"]

LOCAL_DISK: Final = "keep the data directory on a disk of the machine that runs the server"
# What locking a file fails with where the file system, or its server, offers no locks.
NO_LOCKS: Final = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
_REMOTE: Final = ("nfs", "cifs", "smb", "lustre", "9p", "ceph", "gpfs", "beegfs", "afs", "fuse.", "virtiofs", "ncpfs")
_MOUNTS: Final = Path("/proc/self/mountinfo")


def file_system_of(path: Path) -> str | None:
    """The type of the file system that holds a path, such as "ext4" or "nfs4"; None where the system does not say."""
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
        if inside and len(point) >= len(best):  # the last of equals lies on top
            best, kind = point, about[0]
    return kind


def is_remote(kind: str | None) -> bool:
    """Whether a type is one of a network's file systems."""
    return kind is not None and kind.startswith(_REMOTE)


def on_file_system(path: Path) -> str:
    """The file system in brackets, for messages; nothing where the system does not say."""
    kind = file_system_of(path)
    return "" if kind is None else f" (file system {kind})"
