"""A running server goes on while its package is upgraded or removed; what takes a new process says so.

The server runs from a folder of links to all that is installed, which the test takes away.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import Processes

from crkr.protocol import TaskSpec
from crkr.server.inspection.synthetic_log import fill

Ask = Callable[..., dict[str, Any]]
PARTS = ("protocol", "learner", "client", "server")


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder for PYTHONPATH with everything that a server imports, ours as copies."""
    folder = tmp_path / "installed"
    (folder / "crkr").mkdir(parents=True)
    for library in Path(np.__file__).parents[1].iterdir():
        if library.suffix not in (".pth", ".egg-link") and not library.name.startswith(("_", "crkr")):
            (folder / library.name).symlink_to(library)
    about = distribution("crkr")
    (folder / "crkr-0.dist-info").mkdir()
    for name in ("METADATA", "entry_points.txt"):
        (folder / "crkr-0.dist-info" / name).write_text(about.read_text(name) or "")
    root = Path(__file__).parents[2]
    for part in PARTS:
        subprocess.run(["cp", "-r", root / part / "crkr" / part, folder / "crkr" / part], check=True)
    return folder


@pytest.fixture
def started(
    installed: Path,
    free_port: int,
    tmp_path: Path,
    connect: Callable[[str], Ask],
    reach: dict[str, Any],
    processes: Processes,
) -> Iterator[tuple[Ask, Callable[[], str]]]:
    """Questions to a server with one task that runs from there, and how to end it and get its log."""
    endpoint, log = f"tcp/127.0.0.1:{free_port}", tmp_path / "log"
    # Without `site` nothing but that folder is there.
    command = [sys.executable, "-S", "-P", "-m", "crkr.client", "server", "--listen", endpoint]
    environment = {**os.environ, "PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    with (
        log.open("wb") as sink,
        subprocess.Popen([*command, "--data", str(tmp_path / "data")], stderr=sink, env=environment) as process,
    ):
        processes.wait_until(lambda: b"listening on" in log.read_bytes(), log)

        def ended() -> str:
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=10) == 0
            return log.read_text()

        ask = connect(endpoint)
        assert ask("rpc/create_task", reach)["created"] is True
        yield ask, ended
        if process.poll() is None:
            process.kill()


def asks_all(ask: Ask, make_trial: Callable[..., dict[str, Any]], first: int) -> None:
    """Every verb that takes no new process, `info` aside."""
    trials = [make_trial(number) for number in range(first, first + 20)]
    assert ask("task/reach/rpc/report", {"trials": trials, "wait": True})["accepted"] == 20
    assert "goals" in ask("task/reach/rpc/predict", {"states": [0.5, 0.0], "explore": True})
    assert ask("task/reach/rpc/status")["seq"] >= 21
    assert "error" not in ask("task/reach/rpc/samples", {"after": 0, "limit": 5})
    assert "error" not in ask("task/reach/rpc/model")
    assert "error" not in ask("task/reach/rpc/explain", {"state": [0.5, 0.0]})
    assert "error" not in ask("rpc/tasks")
    ids = [trials[0]["id"]]
    assert "error" not in ask("task/reach/admin/recost", {"ids": ids, "costs": [0.25], "reason": ""})
    assert "error" not in ask("task/reach/admin/remove", {"ids": ids, "reason": ""})
    assert "error" not in ask("task/reach/admin/configure", {"changes": {"budget": 30 + first}})


@pytest.mark.parametrize("what", ["everything", "the libraries", "the parts", "the metadata", "nothing"])
def test_a_server_whose_package_is_taken_away_goes_on(
    what: str,
    installed: Path,
    started: tuple[Ask, Callable[[], str]],
    make_trial: Callable[..., dict[str, Any]],
) -> None:
    ask, ended = started
    aside = installed.with_name("aside")
    aside.mkdir()
    gone = {
        "everything": list(installed.iterdir()),
        "the libraries": [path for path in installed.iterdir() if not path.name.startswith("crkr")],
        "the parts": [installed / "crkr"],
        "the metadata": [installed / "crkr-0.dist-info"],
        "nothing": [],
    }[what]
    for path in gone:
        path.rename(aside / path.name)
    asks_all(ask, make_trial, 0)
    fit = ask("task/reach/admin/refit")
    if what in ("nothing", "the metadata"):
        assert "accepted" in fit
    else:
        assert fit["error"]["code"] == "UNSUPPORTED"
        assert "restart the server" in fit["error"]["message"]
    asks_all(ask, make_trial, 20)
    assert "Traceback" not in ended()


def test_a_server_whose_package_is_upgraded_goes_on_and_fits_no_more(
    installed: Path, started: tuple[Ask, Callable[[], str]], make_trial: Callable[..., dict[str, Any]]
) -> None:
    ask, ended = started
    for file in (installed / "crkr").rglob("*.py"):
        file.write_text("raise ImportError('of another version')\n")
    asks_all(ask, make_trial, 0)
    assert ask("task/reach/admin/refit")["error"]["code"] == "UNSUPPORTED"
    assert "Traceback" not in ended()


def test_the_process_that_fits_outlives_an_upgrade(
    installed: Path, started: tuple[Ask, Callable[[], str]], make_trial: Callable[..., dict[str, Any]]
) -> None:
    ask, ended = started
    asks_all(ask, make_trial, 0)
    assert "accepted" in ask("task/reach/admin/refit")
    installed.rename(installed.with_name("aside"))
    asks_all(ask, make_trial, 20)
    assert "accepted" in ask("task/reach/admin/refit")
    assert "Traceback" not in ended()


def test_the_rows_of_a_long_log_are_not_looked_over_by_another_version(
    installed: Path, free_port: int, tmp_path: Path, reach: dict[str, Any], processes: Processes
) -> None:
    fill(tmp_path / "data", TaskSpec.from_dict(reach), 6000)
    command = [sys.executable, "-S", "-P", "-m", "crkr.client", "server", "--data", str(tmp_path / "data")]
    command += ["--listen", f"tcp/127.0.0.1:{free_port}"]
    environment = {**os.environ, "PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, env=environment, text=True) as process:
        assert process.stderr is not None
        while "listening on" not in process.stderr.readline():
            assert process.poll() is None
        (installed / "crkr").rename(tmp_path / "aside")
        while "are not checked: crkr was upgraded or removed" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10) == 0


def test_where_no_file_can_be_opened_nothing_is_said_of_an_upgrade() -> None:
    program = """
import resource
import crkr.server.server
from crkr.server.installed_code import InstalledCode
code = InstalledCode()
resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))
print(code.is_replaced)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
