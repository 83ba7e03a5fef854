"""The lock of an outbox's file lasts as long as its holder, and no longer."""

import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import StorageError, TaskSpec, Trial, make_trials

SPEC = TaskSpec.from_dict(
    {"name": "lob", "state": [{"name": "x", "low": 0, "high": 1}], "goal": [{"name": "g", "low": -1, "high": 1}]}
)


def trials(count: int) -> tuple[Trial, ...]:
    return make_trials(SPEC, state=np.zeros((count, 1)), goal=np.zeros((count, 1)), cost=0.5, success=True)


SECOND = """
import sys
from pathlib import Path
from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import CrkrError
try:
    OutboxFile(Path(sys.argv[1]), "lob").close()
    print("opened")
except CrkrError as error:
    print(error.message)
"""


def second(path: Path) -> str:
    """What another process is told that opens the file."""
    return subprocess.check_output([sys.executable, "-c", SECOND, str(path)], text=True, timeout=30).strip()


def test_its_lock_outlasts_that_its_own_process_reads_the_file(tmp_path: Path) -> None:
    """SQLite's own locks do not: POSIX drops them as any descriptor of the file is closed."""
    path, link = tmp_path / "box", tmp_path / "link"
    link.symlink_to(path)
    file = OutboxFile(path, "lob")
    path.read_bytes()
    shutil.copy(path, tmp_path / "copy")
    for name in (path, link):
        told = second(name)
        assert f"{name} is in use already" in told
        assert f"(process {os.getpid()})" in told
        assert len(told.splitlines()) == 1
    with pytest.raises(StorageError, match="in use already"):
        OutboxFile(path, "lob")
    file.add(trials(2))
    file.close()
    assert second(path) == "opened"
    assert sorted(os.listdir(tmp_path)) == ["box", "copy", "link"]


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    path = tmp_path / "box"
    killed = f"{SECOND.replace('.close()', '')}\nimport os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    command = [sys.executable, "-c", killed, str(path)]
    assert subprocess.run(command, timeout=30, check=False, stdout=subprocess.DEVNULL).returncode == -signal.SIGKILL
    assert path.with_name("box.lock").exists()
    assert second(path) == "opened"


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_lock_that_was_taken_away_is_noticed_before_anything_is_written(tmp_path: Path, how: str) -> None:
    path, lock = tmp_path / "box", tmp_path / "box.lock"
    file = OutboxFile(path, "lob")
    file.add(trials(2))
    lock.unlink()
    if how == "replaced":
        lock.touch()
    with pytest.raises(StorageError, match=r"lock of the outbox .* was removed"):
        file.add(trials(1))
    file.close()
    file = OutboxFile(path, "lob")
    assert file.pending() == 2
    file.close()


def test_a_file_system_without_locks_is_told_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(StorageError, match=r"no file locks .*put it on a disk of this machine"):
        OutboxFile(tmp_path / "box", "lob")


CHILD = """
import os, sys
from pathlib import Path
from crkr.client.outbox.outbox_file import OutboxFile

file = OutboxFile(Path(sys.argv[1]), "lob")
if os.fork() == 0:
    sys.stdin.readline()
    os._exit(0)
print("forked", flush=True)
os._exit(0)
"""


def test_a_forked_child_that_lives_on_does_not_keep_the_lock(tmp_path: Path) -> None:
    command = [sys.executable, "-c", CHILD, str(tmp_path / "box")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdin is not None
        assert parent.stdout is not None
        assert parent.stdout.readline() == "forked\n"
        assert parent.wait(30) == 0
        assert second(tmp_path / "box") == "opened"
        parent.stdin.write("\n")
