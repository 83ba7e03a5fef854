"""A file system without locks, or without memory that processes share, is told with what to do.

The kernel itself refuses: a filter of system calls, installed in a child before it opens a log, fails `flock`, `fcntl`
or a shared mapping as such file systems do.
"""

import errno
import platform
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from crkr.server.log.data_files import file_system_of, is_remote

# System call numbers and the audit name of the architecture.
CALLS = {
    "x86_64": (0xC000003E, {"flock": 73, "fcntl": 72, "mmap": 9}),
    "aarch64": (0xC00000B7, {"flock": 32, "fcntl": 25, "mmap": 222}),
}
# Installs the filter that its second argument says, and opens a log.
OPEN = """
import ctypes, struct, sys
from pathlib import Path
from crkr.protocol import StorageError
from crkr.server.log import SqliteLog
program = bytes.fromhex(sys.argv[2])
code = ctypes.create_string_buffer(program, len(program))
filters = ctypes.create_string_buffer(struct.pack("HxxxxxxP", len(program) // 8, ctypes.addressof(code)))
library = ctypes.CDLL(None, use_errno=True)
NO_NEW_PRIVS, SECCOMP, FILTER = 38, 22, 2
library.prctl(NO_NEW_PRIVS, 1, 0, 0, 0)
if library.prctl(SECCOMP, FILTER, filters):
    raise OSError(ctypes.get_errno(), "no filter")
try:
    SqliteLog(Path(sys.argv[1])).close()
except StorageError as error:
    sys.exit(error.message)
"""
_F_SETLK, _MAP_SHARED = 6, 1


def refusing(call: str, number: int, argument: int | None = None, equal: int = 0) -> bytes:
    """A classic BPF program: `call` fails with the error `number`, if given only where an argument equals a value."""
    architecture, calls = CALLS[platform.machine()]
    load, jump, give = 0x20, 0x15, 0x06  # a word, if equal, return
    allow = struct.pack("HBBI", give, 0, 0, 0x7FFF0000)
    refuse = struct.pack("HBBI", give, 0, 0, 0x00050000 | number)
    program = [
        struct.pack("HBBI", load, 0, 0, 4),
        struct.pack("HBBI", jump, 1, 0, architecture),
        allow,
        struct.pack("HBBI", load, 0, 0, 0),
        struct.pack("HBBI", jump, 1, 0, calls[call]),
        allow,
    ]
    if argument is not None:
        program += [
            struct.pack("HBBI", load, 0, 0, 16 + 8 * argument),
            struct.pack("HBBI", jump, 1, 0, equal),
            allow,
        ]
    return b"".join([*program, refuse])


def opened(directory: Path, program: bytes) -> subprocess.CompletedProcess[str]:
    """Opens a log in a process under the filter."""
    command = [sys.executable, "-c", OPEN, str(directory), program.hex()]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_is_told_in_one_line(tmp_path: Path, number: int) -> None:
    done = opened(tmp_path / "data", refusing("flock", number))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"data directory {tmp_path}/data cannot be locked: ")
    assert line.endswith("; keep the data directory on a disk of the machine that runs the server")


def test_a_file_system_without_locks_on_parts_of_a_file_is_told_in_one_line(tmp_path: Path) -> None:
    done = opened(tmp_path / "data", refusing("fcntl", errno.ENOLCK, argument=1, equal=_F_SETLK))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"data directory {tmp_path}/data cannot be locked: ")
    assert line.endswith("; keep the data directory on a disk of the machine that runs the server")


def test_a_file_system_without_shared_memory_is_told_in_one_line(tmp_path: Path) -> None:
    done = opened(tmp_path / "data", refusing("mmap", errno.ENODEV, argument=3, equal=_MAP_SHARED))
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert "keep the data directory on a disk of the machine that runs the server" in line


def test_the_file_system_is_what_the_kernel_says(tmp_path: Path) -> None:
    said = subprocess.run(["stat", "-f", "-c", "%T", "/proc"], capture_output=True, text=True, check=True)
    assert file_system_of(Path("/proc/self")) == said.stdout.strip() == "proc"
    assert not is_remote(file_system_of(tmp_path))
    assert all(map(is_remote, ("nfs", "nfs4", "cifs", "smb3", "lustre", "9p", "fuse.sshfs")))
