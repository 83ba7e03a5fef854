"""Nobody need read what a server logs: it goes on, and says later that lines are missing."""

import fcntl
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]
LINES = 1200  # more than wait to be written


def test_a_server_whose_log_nobody_reads_goes_on(
    free_port: int, tmp_path: Path, connect: Callable[[str], Ask], reach: dict[str, Any]
) -> None:
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(tmp_path / "data")]
    with subprocess.Popen(command, stderr=writing) as process, os.fdopen(reading, "rb", buffering=0) as told:
        os.close(writing)
        first = b""
        while b"listening on" not in first:
            first += told.read(1000)
        ask = connect(endpoint)
        for number in range(LINES):  # each is a line of the log
            assert ask("rpc/create_task", {**reach, "name": f"task-{number}"})["created"] is True
        text = b""
        while b"lines of the log were not written" not in text:
            text += told.read(1000)
            assert ask("rpc/create_task", {**reach, "name": f"more-{len(text)}"})["created"] is True
        lost = re.search(rb"\((\d+) lines of the log were not written: nobody read them\)\n", text)
        assert lost is not None
        assert 0 < int(lost[1]) < LINES
        assert text.startswith(b"20")
        for number in range(LINES):
            ask("rpc/create_task", {**reach, "name": f"late-{number}"})
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0


def test_a_server_whose_log_is_closed_goes_on(
    free_port: int, tmp_path: Path, connect: Callable[[str], Ask], reach: dict[str, Any]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(tmp_path / "data")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "listening on" in process.stderr.readline()
        process.stderr.close()
        ask = connect(endpoint)
        for number in range(3):
            assert ask("rpc/create_task", {**reach, "name": f"task-{number}"})["created"] is True
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60) == 0


def test_a_server_whose_log_is_full_or_was_never_open_goes_on(
    free_port: int, tmp_path: Path, connect: Callable[[str], Ask], reach: dict[str, Any]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    for sink in ("2>/dev/full", "<&- >&- 2>&-"):
        line = f"exec {sys.executable} -m crkr.client server --listen {endpoint} --data {tmp_path / 'data'} {sink}"
        with subprocess.Popen(["bash", "-c", line]) as process:
            with Client(endpoint) as client:
                client.wait_until_ready(60)  # it listens before it answers
            ask = connect(endpoint)
            assert ask("rpc/create_task", {**reach, "name": f"task-{len(sink)}"})["created"] is True
            taken = {os.readlink(f"/proc/{process.pid}/fd/{number}") for number in range(3)}
            assert not any("data" in name or "socket" in name for name in taken)
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10) == 0


def test_logging_what_cannot_be_formatted_raises_nothing() -> None:
    program = """
import logging
from crkr.server.stderr_log import StderrLog
log = StderrLog(logging.INFO)
logging.getLogger("crkr.here").info("%d of %d", 1)
logging.getLogger("crkr.here").info("and on")
log.flush(20.0)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    first, second = ended.stderr.splitlines()
    assert "crkr.here, line 5: TypeError" in first
    assert second.endswith("INFO crkr.here: and on")
