import os
import pty
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from processes import Processes, RunningServer

from crkr.client import Task

Watch = Callable[..., subprocess.Popen[str]]
LEADS_A_SESSION = """
import fcntl, os, sys, termios
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
PATIENCE_S = 60.0  # no promise, just no hang


@pytest.fixture
def watch() -> Iterator[Watch]:
    """Starts `crkr watch crane ...`; killed at the end if the test has not ended it."""
    with ExitStack() as stack:

        def start(*options: str, **environment: str) -> subprocess.Popen[str]:
            command = [sys.executable, "-m", "crkr.client", "watch", "crane", *options]
            process = stack.enter_context(
                subprocess.Popen(
                    command,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    text=True,
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1"} | environment,
                )
            )
            stack.callback(process.kill)  # does nothing to one that has ended
            return process

        yield start


def line_with(stream: Any, text: str) -> str:
    """Reads on until a line holds the text."""
    seen = []
    for line in stream:
        seen.append(line)
        if text in line:
            return str(line).strip()
    pytest.fail(f"{text!r} was not said: {seen}")


def report(task: Task, count: int) -> None:
    task.report(state=[[5.0]] * count, goal=[[0.1]] * count, cost=0.5, success=True, worker="crane-1")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_completes_the_recording_and_ends_the_page(
    crane: Task, server: RunningServer, watch: Watch, tmp_path: Path, number: signal.Signals
) -> None:
    report(crane, 120)
    file = tmp_path / "run.rrd"
    process = watch("--connect", server.endpoint, "--save", str(file), "--log-level", "info")
    address = line_with(process.stderr, "viewer: ").removeprefix("viewer: ")
    page = address.split("?")[0]
    with urllib.request.urlopen(page, timeout=PATIENCE_S) as answer:
        assert answer.status == 200
    line_with(process.stderr, "caught up with 120 trials")
    process.send_signal(number)
    if number == signal.SIGHUP:
        process.send_signal(number)  # shell and kernel both send one
    _, rest = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, rest
    assert f"recording: {file}" in rest
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", int(page.rstrip("/").rpartition(":")[2]))) != 0
    assert rows(file, "/cost/success") == 120
    (guide,) = [batch.column("TextDocument:text")[0].as_py() for batch in batches(file, "/guide")]
    assert "Lift loads." in guide[0]


def test_a_closed_terminal_completes_the_recording(crane: Task, server: RunningServer, tmp_path: Path) -> None:
    report(crane, 120)
    file = tmp_path / "run.rrd"
    words = ["watch", "crane", "--connect", server.endpoint, "--save", str(file), "--log-level", "info"]
    # In a session whose terminal this is, which is hung up as it is closed.
    command = [sys.executable, "-c", LEADS_A_SESSION, sys.executable, "-m", "crkr.client", *words]
    ours, theirs = pty.openpty()
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        written = b""
        while b"caught up with" not in written:
            written += os.read(ours, 4096)
        os.close(ours)  # what is printed from now on fails
        assert process.wait(PATIENCE_S) == 0
    assert rows(file, "/cost/success") == 120


def rows(file: Path, entity: str) -> int:
    """Rows in time of an entity of a complete recording."""
    return sum(batch.num_rows for batch in batches(file, entity) if "trial" in batch.schema.names)


def batches(file: Path, entity: str) -> list[Any]:
    """What a complete recording holds of an entity."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(file))
    (store,) = reader.recordings()
    return [chunk.to_record_batch() for chunk in reader.stream(store=store).filter(content=entity).to_chunks()]


def test_without_a_terminal_the_tables_become_lines(crane: Task, server: RunningServer, watch: Watch) -> None:
    report(crane, 7)
    process = watch("--terminal", "--connect", server.endpoint)
    assert "trials 7" in line_with(process.stdout, "trials")
    process.send_signal(signal.SIGTERM)
    assert process.wait(PATIENCE_S) == 0


def test_a_missing_server_is_one_line_and_status_1(watch: Watch, free_port: int) -> None:
    process = watch("--terminal", "--patience", "1", "--connect", f"tcp/127.0.0.1:{free_port}")
    out, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert out == ""
    assert [line.split()[0] for line in error.splitlines()] == ["waiting", "error:"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_it_waits_for_a_server_ends_it(watch: Watch, free_port: int, number: signal.Signals) -> None:
    for _ in range(3):
        process = watch(
            "--terminal", "--patience", "600", "--timeout", "0.5", "--connect", f"tcp/127.0.0.1:{free_port}"
        )
        line_with(process.stderr, "waiting up to 600 s")
        process.send_signal(number)
        _, rest = process.communicate(timeout=PATIENCE_S)
        assert (process.returncode, rest) == (0, "")


def test_a_second_ctrl_c_ends_the_process_at_once(watch: Watch, free_port: int, processes: Processes) -> None:
    """It is in the middle of a question that goes on for ten minutes."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    process = watch("--terminal", "--timeout", "600", "--connect", endpoint, "--log-level", "info")
    line_with(process.stderr, "trying again")

    def ended() -> bool:
        process.send_signal(signal.SIGINT)
        return process.poll() is not None

    processes.wait_until(ended)
    assert process.returncode == -signal.SIGINT


def test_a_taken_port_that_was_asked_for_is_one_line_and_status_1(watch: Watch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        _, error = watch("--port", port).communicate(timeout=PATIENCE_S)
    assert error.splitlines() == [
        f"error: port {port} on 127.0.0.1 is taken; choose another, or none and a free one is found"
    ]


def test_a_window_without_a_display_is_one_line_and_status_1(watch: Watch) -> None:
    _, error = watch("--native", DISPLAY="", WAYLAND_DISPLAY="").communicate(timeout=PATIENCE_S)
    assert error.splitlines()[-1] == "error: --native needs a display, and there is none here; use --web or --terminal"


@pytest.mark.parametrize(
    "options",
    [
        ["--web", "--terminal"],
        ["--terminal", "--save", "x.rrd"],
        ["--terminal", "--web-port", "9191"],
        ["--bind", "everywhere"],
    ],
)
def test_options_that_make_no_sense_together_are_wrong_usage(watch: Watch, options: list[str]) -> None:
    process = watch(*options)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2


def test_a_file_that_cannot_be_written_is_an_error_at_once(watch: Watch, tmp_path: Path) -> None:
    process = watch("--save", str(tmp_path / "missing" / "run.rrd"))
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "missing" in error
    assert len(error.splitlines()) == 1


def test_an_existing_recording_is_replaced_only_with_overwrite(watch: Watch, tmp_path: Path, free_port: int) -> None:
    file = tmp_path / "night.rrd"
    file.write_text("of last night")
    away = ("--save", str(file), "--patience", "0.1", "--timeout", "0.2", "--connect", f"tcp/127.0.0.1:{free_port}")
    _, error = watch(*away).communicate(timeout=PATIENCE_S)
    assert error.splitlines() == [f"error: {file} exists; choose another file, or --overwrite"]
    process = watch(*away, "--overwrite")
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert [path.read_text() for path in tmp_path.iterdir()] == ["of last night"]


def test_a_run_without_a_task_leaves_no_recording(watch: Watch, tmp_path: Path, free_port: int) -> None:
    file = tmp_path / "run.rrd"
    away = ("--patience", "0.1", "--timeout", "0.2", "--connect", f"tcp/127.0.0.1:{free_port}")
    _, error = watch("--save", str(file), *away).communicate(timeout=PATIENCE_S)
    assert "did not appear" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "environment",
    [
        {"RERUN": "off"},
        {"RERUN_STRICT": "1", "RERUN_PANIC_ON_WARN": "1", "RERUN_FLUSH_TICK_SECS": "soon"},
        {"_RERUN_TEST_FORCE_SAVE": "/nowhere/at.rrd"},
        {"http_proxy": "http://127.0.0.1:9", "HTTP_PROXY": "http://127.0.0.1:9", "no_proxy": "", "NO_PROXY": ""},
        {"PYTHONWARNINGS": "error", "LC_ALL": "C", "PYTHONUTF8": "0"},
    ],
    ids=lambda environment: next(iter(environment)),
)
def test_reruns_environment_variables_do_not_change_a_recording(
    crane: Task, server: RunningServer, watch: Watch, tmp_path: Path, environment: dict[str, str]
) -> None:
    report(crane, 30)
    file = tmp_path / "run.rrd"
    file.write_text("of last night")
    process = watch(
        "--connect", server.endpoint, "--save", str(file), "--overwrite", "--log-level", "info", **environment
    )
    line_with(process.stderr, "viewer: ")
    line_with(process.stderr, "caught up with 30 trials")
    process.send_signal(signal.SIGHUP)
    _, rest = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, rest
    assert rest.splitlines()[-1] == f"recording: {file}"
    assert rows(file, "/cost/success") == 30
    assert list(tmp_path.glob("*.rrd")) == [file]
