"""A system that lets the server start no more threads or processes: it says so and continues."""

import os
import resource
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from processes import RunningServer, wait_until

Ask = Callable[..., dict[str, Any]]
STACK = 2**28  # of each thread that the server starts; what else it maps is smaller
SPARE = STACK // 2


@contextmanager
def large_stacks() -> Iterator[None]:
    """Processes that are started here give their threads large stacks, of which a limit of memory allows few."""
    before = resource.getrlimit(resource.RLIMIT_STACK)
    resource.setrlimit(resource.RLIMIT_STACK, (STACK, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_STACK, before)


def mapped(pid: int) -> int:
    """Bytes of its address space."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")


def test_a_server_that_can_start_no_thread_answers_and_tells(
    start_server: Callable[..., RunningServer],
    free_port: int,
    connect: Callable[[str], Ask],
    reach: dict[str, Any],
    make_trial: Callable[..., dict[str, Any]],
) -> None:
    with large_stacks():
        server = start_server("--metrics", str(free_port))
    ask, pid = connect(server.endpoint), server.process.pid
    ask("rpc/create_task", reach)
    limited, unlimited = resource.prlimit(pid, resource.RLIMIT_AS)
    resource.prlimit(pid, resource.RLIMIT_AS, (mapped(pid) + SPARE, unlimited))
    assert ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})["accepted"] == 1
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1
    with urllib.request.urlopen(f"http://127.0.0.1:{free_port}/metrics", timeout=60) as answer:
        assert b'crkr_thread_faults_total{thread="metrics"} 1.0' in answer.read()
    assert any(name.startswith("intake") for name in ask("rpc/info", {})["threads"]["faults"])
    assert "can't start new thread" in server.log.read_text()
    resource.prlimit(pid, resource.RLIMIT_AS, (limited, unlimited))
    assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1


def test_a_fit_is_busy_while_no_process_can_be_started(
    server: RunningServer, connect: Callable[[str], Ask], reach: dict[str, Any], make_trial: Callable[..., Any]
) -> None:
    ask, pid = connect(server.endpoint), server.process.pid
    ask("rpc/create_task", reach)
    ask("task/reach/rpc/report", {"trials": [make_trial(number) for number in range(30)], "wait": True})
    before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
    most = next(number for number in range(before[0]) if not Path(f"/proc/{pid}/fd/{number}").exists()) + 1
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (most, before[1]))  # one more file
    error = ask("task/reach/admin/refit", {})["error"]
    assert error["code"] == "BUSY"
    assert "raise the server's limit" in error["message"]
    resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
    wait_until(lambda: "error" not in ask("task/reach/admin/refit", {}), server.log)


def test_a_server_that_may_start_too_few_threads_says_so_in_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", "tcp/127.0.0.1:0", "--data", str(tmp_path)]
    limits = f"ulimit -s {STACK >> 10} && ulimit -v {24 * STACK >> 10} && exec"
    done = subprocess.run(
        ["bash", "-c", f'{limits} "$0" "$@"', *command], capture_output=True, text=True, check=False, timeout=100
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: the system lets this process start ")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
