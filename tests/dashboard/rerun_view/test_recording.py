import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import rerun as rr
from processes import Processes

from crkr.dashboard.rerun_view import Recording

HOST = "127.0.0.1"
LOOPBACK = "0100007F"  # as /proc/net/tcp writes it


def test_what_was_logged_is_in_the_file_when_it_is_closed(
    recording: Recording, file: Path, read: Callable[[Path], dict[str, Any]]
) -> None:
    recording.fixed(["a", "b / c"], rr.TextDocument("always"))
    recording.at({"trial": 3, "epoch": 1}, ["log"], rr.TextLog("then"))
    assert recording.close(5.0)
    tables = read(file)
    assert tables[r"/a/b\ \/\ c"][0].column("TextDocument:text").to_pylist() == [["always"]]
    assert tables["/log"][0].column("trial").to_pylist() == [3]


def test_every_run_is_a_separate_recording(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    identities = set()
    for name in ("one.rrd", "two.rrd"):
        recording = Recording(None, tmp_path / name)
        recording.at({"trial": 1}, ["log"], rr.TextLog("here"))
        assert recording.close(5.0)
        (store,) = RrdReader(str(tmp_path / name)).recordings()
        identities.add(store.recording_id)
    assert len(identities) == 2


def test_the_recording_is_served_on_loopback_only(free_port: int, processes: Processes) -> None:
    recording = Recording((HOST, free_port), None)

    def hosts() -> set[str]:
        lines = [line for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]]
        rows = [line.split() for line in lines]
        return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[1].endswith(f":{free_port:04X}")}

    assert processes.wait_until(hosts) == {LOOPBACK}
    assert recording.close(5.0)


@pytest.mark.parametrize("megabytes", [40])
def test_a_viewer_that_does_not_read_holds_up_neither_logging_nor_closing(
    megabytes: int, free_port: int, file: Path, read: Callable[[Path], dict[str, Any]]
) -> None:
    stuck_viewer = (
        "import socket, sys\n"
        f"with socket.create_connection(('{HOST}', {free_port}), 10):\n"
        "    print('connected', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    recording = Recording((HOST, free_port), file, memory_limit="16MiB")
    with subprocess.Popen(
        [sys.executable, "-c", stuck_viewer], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as viewer:
        assert viewer.stdout is not None
        assert viewer.stdout.readline() == "connected\n"
        os.kill(viewer.pid, signal.SIGSTOP)
        try:
            points = rr.Points3D([[0.0, 0.0, 0.0]] * 80_000)  # about a megabyte
            for trial in range(megabytes):
                recording.at({"trial": trial}, ["points"], points)
            assert recording.close(20.0)
        finally:
            os.kill(viewer.pid, signal.SIGCONT)
    assert sum(batch.num_rows for batch in read(file)["/points"]) == megabytes
