"""Servers in processes of their own, and questions about processes and time."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from crkr.client import Client

PATIENCE_S = 100.0
GONE_WITHIN_S = 60.0
SERVER_PYTHON = os.environ.get("CRKR_SERVER_PYTHON", sys.executable)  # where the client's is an earlier one


@dataclass(frozen=True, slots=True)
class RunningServer:
    """A `crkr server` process that answers; `data` is its directory, unused with a database."""

    endpoint: str
    port: int
    data: Path
    log: Path
    process: subprocess.Popen[bytes]


@contextmanager
def shared_server(data: Path | str, *options: str) -> Iterator[str]:
    """The endpoint of a server that answers."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    command = [SERVER_PYTHON, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data), *options]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            with Client(endpoint) as client:
                client.wait_until_ready(PATIENCE_S)
            yield endpoint
        finally:
            process.terminate()
            assert process.wait(GONE_WITHIN_S) == 0


def wait_until(look: Callable[[], Any], log: Path | None = None) -> Any:
    """What `look` gives as soon as that is true; fails after a long patience: speed is not the question."""
    deadline, pause = time.monotonic() + PATIENCE_S, threading.Event()
    while not (found := look()):
        if time.monotonic() > deadline:
            pytest.fail(f"waited in vain; the log says:\n{log.read_text() if log else ''}")
        pause.wait(0.02)
    return found


def children(pid: int) -> list[int]:
    """Processes that a process has started and that still run."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except FileNotFoundError:
        return []


def descendants(pid: int) -> list[int]:
    """Children, their children, and so on."""
    return [each for child in children(pid) for each in [child, *descendants(child)]]


def command_line(pid: int) -> str:
    """Words of a process; empty when it is gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def running(pids: list[int]) -> list[int]:
    """The processes that still run; a zombie does not."""
    return [pid for pid in pids if command_line(pid)]


@dataclass(frozen=True, slots=True)
class Processes:
    """What tests ask about processes and time."""

    wait_until: Callable[..., Any] = wait_until
    children: Callable[[int], list[int]] = children
    descendants: Callable[[int], list[int]] = descendants
    running: Callable[[list[int]], list[int]] = running
    command_line: Callable[[int], str] = command_line
