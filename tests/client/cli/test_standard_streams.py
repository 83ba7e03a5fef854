"""A command whose output is closed, full or no longer read ends without a traceback."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CRKR = f"{sys.executable} -m crkr.client"


def shell(line: str) -> subprocess.CompletedProcess[str]:
    """Runs a line of bash; its status is that of the last `crkr`."""
    return subprocess.run(["bash", "-c", line], check=False, capture_output=True, text=True, timeout=120)


@pytest.fixture(params=["tasks", "status --json"])
def question(request: pytest.FixtureRequest, shared_endpoint: str) -> str:
    return f"{CRKR} {request.param} --connect {shared_endpoint}"


WORDS = ("--version", "report --help", "create examples/throw.toml --write -")
COMMANDS = [f"{CRKR} {words}" for words in WORDS]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_full_standard_output_is_told_in_one_line(command: str) -> None:
    done = shell(f"{command} >/dev/full")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert "No space left on device" in line


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_ends_quietly_when_its_reader_closes_the_output(command: str) -> None:
    done = shell(f"{command} | true; exit ${{PIPESTATUS[0]}}")  # which leaves long before anything is written
    assert done.returncode == 141
    assert done.stderr == ""


@pytest.mark.parametrize("command", COMMANDS)
def test_a_closed_standard_output_is_no_failure(command: str) -> None:
    for closed in (">&-", ">&- 2>&-", "<&- >&- 2>&-"):
        done = shell(f"{command} {closed}")
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_answers_of_a_server_that_cannot_be_written_end_so_too(question: str) -> None:
    full = shell(f"{question} >/dev/full")
    assert full.returncode == 1
    assert full.stderr == "error: standard output cannot be written: No space left on device\n"
    left = shell(f"{question} | true; exit ${{PIPESTATUS[0]}}")
    assert left.returncode in (0, 141)
    assert left.stderr == ""
    assert shell(f"{question} >&-").returncode == 0


def test_an_error_without_standard_error_is_an_exit_status() -> None:
    for sink in ("2>/dev/full", "2>&-", "2> >(true)"):
        assert shell(f"{CRKR} status --connect tcp/127.0.0.1:1 --timeout 0.1 {sink}").returncode == 1


def test_a_bar_on_a_closed_stream_stops_nothing() -> None:
    program = """
import os
from crkr.client.cli.progress import Progress
from crkr.client.cli.console import stderr, stdout
reading, writing = os.pipe()
os.close(reading)
os.dup2(writing, 2)  # as a pager that was left
with Progress(stderr, "importing [/red]x", 3, "trials") as bar:
    for done in range(3):
        bar.show(done)
        stderr.print("a line")
stdout.print("[red]literal[/red]")
"""
    terminal = {**os.environ, "TTY_COMPATIBLE": "1", "NO_COLOR": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60, env=terminal
    )
    assert (done.returncode, done.stdout) == (0, "[red]literal[/red]\n")


def test_descriptors_that_were_closed_are_not_taken_by_files(tmp_path: Path) -> None:
    program = f"""
import os
from crkr.client.cli.standard_streams import open_streams
open_streams()
file = os.open({str(tmp_path / "data")!r}, os.O_RDWR | os.O_CREAT)
os._exit(file)
"""
    done = shell(f"{sys.executable} -c {program!r} <&- >&- 2>&-".replace("\\n", "\n"))
    assert done.returncode > 2
    assert os.path.getsize(tmp_path / "data") == 0


def test_the_traceback_of_a_defect_does_not_act_on_the_terminal() -> None:
    program = """
import sys
from crkr.client.cli.main import main
sys.argv = ["crkr", "--version"]
import importlib.metadata
def fail(package):
    raise RuntimeError("\\x1b[2J")
import threading
thread = threading.Thread(target=fail, args=("",))
def both(*words):
    thread.start()
    thread.join()
    fail(words)
importlib.metadata.version = both
main()
"""
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("Exception in thread Thread-1")
    assert done.stderr.count("RuntimeError: \\x1b[2J\n") == 2
    assert done.stderr.endswith("RuntimeError: \\x1b[2J\n")
