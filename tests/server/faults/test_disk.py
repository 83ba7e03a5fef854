"""A disk that is full or can only be read: reports are refused, predictions go on, and nothing acknowledged is lost."""

import os
import resource
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from processes import RunningServer

from crkr.server.log import SqliteLog

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Connect = Callable[[str], Ask]
DISK_BYTES = 8 * 2**20


def samples(ask: Ask) -> list[bytes]:
    page = ask("task/reach/rpc/samples", {"limit": 10_000})
    assert page["next"] is None
    return [sample["id"] for sample in page["samples"]]


@pytest.mark.parametrize("writable", [4096, 0])
def test_where_nothing_can_be_written_reports_are_refused_while_predictions_go_on(
    writable: int, server: RunningServer, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any]
) -> None:
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    pid, unlimited = server.process.pid, resource.RLIM_INFINITY
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (writable, unlimited))  # writes beyond that place in a file fail
    error = ask("task/reach/rpc/report", {"trials": [make_trial(1)]})["error"]
    assert error["code"] == "STORAGE"
    assert ask("rpc/create_task", {**reach, "name": "other"})["error"]["code"] == "STORAGE"
    recost = ask("task/reach/admin/recost", {"ids": [make_trial(0)["id"]], "costs": [0.5]})
    assert recost["error"]["code"] == "STORAGE"
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1
    assert samples(ask) == [make_trial(0)["id"]]
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (unlimited, unlimited))
    receipt = ask("task/reach/rpc/report", {"trials": [make_trial(1), make_trial(2)], "wait": True})
    assert (receipt["accepted"], receipt["seqs"]) == (2, [3, 4])
    assert ask("rpc/create_task", {**reach, "name": "other"})["created"] is True


def test_a_log_that_is_moved_away_takes_nothing_until_it_is_back(
    server: RunningServer, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any]
) -> None:
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    away = server.data.with_name("away")
    server.data.rename(away)
    for _ in range(2):
        error = ask("task/reach/rpc/report", {"trials": [make_trial(1)]})["error"]
        assert error["code"] == "STORAGE"
        assert "moved, removed or replaced" in error["message"]
        server.data.mkdir(exist_ok=True)
        (server.data / "crkr.sqlite3").write_bytes((away / "crkr.sqlite3").read_bytes())  # another file of that name
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1
    (server.data / "crkr.sqlite3").unlink()
    server.data.rmdir()
    away.rename(server.data)
    assert ask("task/reach/rpc/report", {"trials": [make_trial(1)]})["seqs"] == [3]
    assert samples(ask) == [make_trial(0)["id"], make_trial(1)["id"]]


@dataclass(frozen=True, slots=True)
class OnDisk:
    """A server whose data directory is a disk of its own, which nobody else sees."""

    process: "subprocess.Popen[bytes]"
    disk: Path

    def fill(self) -> None:
        """Leaves no block free."""
        with (self.disk / "ballast").open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                return

    def free(self) -> None:
        (self.disk / "ballast").unlink()


def command(image: Path, where: Path, endpoint: str, options: str) -> list[str]:
    server = f"exec {sys.executable} -m crkr.client server --listen {endpoint} --data {where}"
    return ["unshare", "-m", "sh", "-ec", f"mount -o loop,errors=remount-ro,{options} {image} {where}; {server}"]


@contextmanager
def serving(image: Path, where: Path, endpoint: str) -> Iterator[OnDisk]:
    log = image.with_name("log")
    with log.open("w") as sink, subprocess.Popen(command(image, where, endpoint, "rw"), stderr=sink) as process:
        try:
            while "listening on" not in log.read_text():  # the pytest timeout is the deadline
                assert process.poll() is None, log.read_text()
            yield OnDisk(process, Path(f"/proc/{process.pid}/root{where}"))  # its mounts, seen from here
        finally:
            process.kill()


def refused(image: Path, where: Path, endpoint: str, options: str) -> str:
    done = subprocess.run(
        command(image, where, endpoint, options), capture_output=True, text=True, timeout=20, check=False
    )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    return done.stderr


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """A small disk with a file system on it; to use it takes the right to mount."""
    path = tmp_path / "disk"
    with path.open("wb") as file:
        file.truncate(DISK_BYTES)
    subprocess.run(["mkfs.ext4", "-q", "-m", "0", str(path)], check=True, capture_output=True)
    (tmp_path / "mounted").mkdir()
    return path


@pytest.mark.campaign
def test_a_disk_that_fills_up_again_and_again_loses_nothing(
    image: Path, free_port: int, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any]
) -> None:
    where, endpoint = image.with_name("mounted"), f"tcp/127.0.0.1:{free_port}"
    told = {"info": {"text": "x" * 500}}
    acknowledged: list[bytes] = []
    number = 0
    for turn in range(5):
        with serving(image, where, endpoint) as server, ExitStack() as undo:
            ask = connect(endpoint)
            ask("rpc/create_task", reach)
            assert samples(ask) == acknowledged
            for _ in range(3):
                server.fill()
                undo.callback(server.free)
                found = ""
                while found != "STORAGE":  # until what room the write-ahead log still had is used up
                    reply = ask("task/reach/rpc/report", {"trials": [make_trial(number, **told)]})
                    found = reply["error"]["code"] if "error" in reply else ""
                    if not found:
                        acknowledged.append(make_trial(number)["id"])
                        number += 1
                assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]}).get("active", 0) > 0 or not acknowledged
                assert samples(ask) == acknowledged
                undo.pop_all().close()
                for _ in range(10):
                    assert ask("task/reach/rpc/report", {"trials": [make_trial(number, **told)]})["accepted"] == 1
                    acknowledged.append(make_trial(number)["id"])
                    number += 1
            if turn % 2:  # killed while it is full
                server.fill()
                server.process.kill()
            else:
                server.process.terminate()
            server.process.wait(timeout=10)
        if turn % 2:
            with_room(image, where)
    assert number >= 150


def with_room(image: Path, where: Path) -> None:
    script = f"mount -o loop {image} {where}; rm -f {where}/ballast"
    subprocess.run(["unshare", "-m", "sh", "-ec", script], check=True)


@pytest.mark.campaign
def test_a_disk_that_becomes_read_only_stops_reports_only(
    image: Path, free_port: int, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any]
) -> None:
    where, endpoint = image.with_name("mounted"), f"tcp/127.0.0.1:{free_port}"
    acknowledged = [make_trial(number)["id"] for number in range(20)]
    with serving(image, where, endpoint) as server:
        ask = connect(endpoint)
        ask("rpc/create_task", reach)
        for number in range(20):
            assert ask("task/reach/rpc/report", {"trials": [make_trial(number)], "wait": True})["accepted"] == 1
        device = Path(subprocess.check_output(["losetup", "-j", str(image), "-n", "-O", "NAME"], text=True).strip())
        Path(f"/sys/fs/ext4/{device.name}/trigger_fs_error").write_text("as if the disk had failed")
        for number in range(20, 25):
            assert ask("task/reach/rpc/report", {"trials": [make_trial(number)]})["error"]["code"] == "STORAGE"
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 20
        assert samples(ask) == acknowledged
        server.process.terminate()
        assert server.process.wait(timeout=10) == 0
    subprocess.run(["e2fsck", "-fy", str(image)], check=False, capture_output=True)  # its status tells what it mended
    assert str(where) in refused(image, where, endpoint, "ro")
    with serving(image, where, endpoint):
        ask = connect(endpoint)
        assert samples(ask) == acknowledged
        assert ask("task/reach/rpc/report", {"trials": [make_trial(20)], "wait": True})["accepted"] == 1


@pytest.mark.parametrize(("suffix", "left"), [("-wal", 0.0), ("-wal", 0.5), ("-wal", 0.97), ("-shm", 0.0)])
def test_a_log_whose_file_is_cut_short_takes_nothing_more_and_is_not_made_worse(
    server: RunningServer, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any], suffix: str, left: float
) -> None:
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    for number in range(40):
        ask("task/reach/rpc/report", {"trials": [make_trial(number)]})
    file = server.data / f"crkr.sqlite3{suffix}"
    kept = file.read_bytes()
    os.truncate(file, int(left * len(kept)))
    for _ in range(2):
        error = ask("task/reach/rpc/report", {"trials": [make_trial(40)]})["error"]
        assert (error["code"], f"{suffix} was cut short" in error["message"]) == ("STORAGE", True)
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] > 0
    before = (server.data / "crkr.sqlite3").read_bytes()
    end = server.process.kill if suffix == "-shm" else server.process.terminate
    end()
    server.process.wait(60)
    assert (server.data / "crkr.sqlite3").read_bytes() == before
    file.write_bytes(kept)
    log = SqliteLog(server.data)
    assert log.reads.last("reach") == 41
    log.close()


def test_a_checkpoint_or_a_vacuum_of_another_program_is_no_cut(
    server: RunningServer, connect: Connect, make_trial: MakeTrial, reach: dict[str, Any]
) -> None:
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    for number, statement in enumerate(
        ["PRAGMA wal_checkpoint(TRUNCATE)", "VACUUM", "PRAGMA wal_checkpoint(TRUNCATE)"]
    ):
        assert ask("task/reach/rpc/report", {"trials": [make_trial(number)]})["accepted"] == 1
        with closing(sqlite3.connect(server.data / "crkr.sqlite3")) as other:
            other.execute(statement)
    assert ask("task/reach/rpc/report", {"trials": [make_trial(9)]})["accepted"] == 1
