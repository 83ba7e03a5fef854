"""`crkr demo`, as a new user starts it: real processes, an empty folder, and what may go wrong."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from processes import Processes

SKILLS = Path(__file__).parents[1] / "sim_worker"
PATIENCE_S = 60.0
QUICK = ("--skill", "reaching:make", "--no-dashboard")


@dataclass(frozen=True, slots=True)
class Demo:
    """A demo that runs."""

    process: subprocess.Popen[str]
    log: Path
    processes: Processes

    def finish(self) -> tuple[int, dict[str, Any], str]:
        """Exit status, its JSON object (empty if it printed none) and its standard error."""
        output, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, json.loads(output or "{}"), self.log.read_text()

    def result(self) -> dict[str, Any]:
        status, result, log = self.finish()
        assert status == 0, log
        return result

    def wait_for(self, text: str) -> None:
        self.wait_until(lambda: text in self.log.read_text() or self.process.poll() is not None)
        assert text in self.log.read_text()

    def wait_until(self, look: Callable[[], Any]) -> Any:
        return self.processes.wait_until(look, self.log)

    def members(self) -> list[int]:
        """Every process that it has started, and theirs."""
        members: list[int] = self.processes.descendants(self.process.pid)
        return members


def named(demo: Demo, text: str) -> list[int]:
    return [pid for pid in demo.members() if text in demo.processes.command_line(pid)]


@pytest.fixture
def start_demo(tmp_path: Path, processes: Processes) -> Iterator[Callable[..., Demo]]:
    """Starts demos in an empty folder; what still runs at the end of the test is ended."""
    count = iter(range(100))
    with ExitStack() as stack:

        def start(*options: str, path: tuple[Path, ...] = ()) -> Demo:
            options = options if "--port" in options else (*options, "--port", "0")
            log = tmp_path / f"demo-{next(count)}.log"
            environment = {
                **os.environ,
                "PYTHONPATH": os.pathsep.join(map(str, (SKILLS, *path))),
                "OPENBLAS_NUM_THREADS": "1",
            }
            process = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "crkr.client", "demo", "--json", *options],
                    cwd=tmp_path,
                    env=environment,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=stack.enter_context(log.open("wb")),
                    text=True,
                )
            )
            stack.callback(process.kill)
            return Demo(process, log, processes)

        yield start


@pytest.fixture
def without_rerun(tmp_path: Path) -> Path:
    """A folder whose `rerun` behaves like a package that is not installed."""
    package = tmp_path / "stubs" / "rerun"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise ModuleNotFoundError('No module named rerun', name='rerun')\n")
    return package.parent


def test_a_short_demo_of_table_tennis_learns_and_leaves_what_it_says(
    start_demo: Callable[..., Demo], without_rerun: Path, tmp_path: Path
) -> None:
    result = start_demo("--trials", "60", "--no-dashboard", path=(without_rerun,)).result()
    assert result["trials"] == 60
    assert result["demonstrations"] == 5
    assert result["samples"] == 5 + 60 + 2 * 50
    assert [(epoch["epoch"], epoch["balls"]) for epoch in result["epochs"]] == [(0, 50), (1, 50)]
    for rates in (result["success_before"], result["success_after"], *result["epochs"]):
        assert 0.0 <= rates["strict"] <= rates["paper"] <= 1.0
    assert result["success_before"]["paper"] > 0.2  # five demonstrations are worth something
    assert result["trials_per_second"] > 0.0
    assert result["wall_seconds"] > 0.0
    assert 5 <= result["active"] <= 65
    assert result["recording"] is None
    assert Path(result["figure"]).read_bytes().startswith(b"\x89PNG")
    assert Path(result["data"]) == tmp_path / "crkr-demo"
    assert (result["workers_lost"], result["seed"], result["resumed"]) == (0, 0, False)


def test_a_demo_keeps_its_log_in_a_database_and_is_resumed_from_there(
    start_demo: Callable[..., Demo], make_database: Callable[[], str], tmp_path: Path
) -> None:
    url = make_database()
    assert start_demo(*QUICK, "--trials", "20", "--data", url).result()["trials"] == 20
    result = start_demo(*QUICK, "--trials", "30", "--data", url).result()
    assert (result["trials"], result["resumed"]) == (30, True)
    assert Path(result["data"]) == tmp_path / "crkr-demo"
    assert not list((tmp_path / "crkr-demo").glob("*.sqlite3"))


def test_a_demo_on_the_same_data_is_resumed_with_its_own_seed(start_demo: Callable[..., Demo]) -> None:
    first = start_demo(*QUICK, "--trials", "60").result()
    demo = start_demo(*QUICK, "--trials", "110", "--seed", "7")
    second = demo.result()
    assert "resuming: 60 training trials" in demo.log.read_text()
    assert "task reaching exists and keeps its seed 0, whatever --seed says" in demo.log.read_text()
    assert second["seed"] == 0
    assert second["resumed"]
    assert second["trials"] == 110
    assert second["demonstrations"] == 5
    assert second["epochs"][:2] == first["epochs"]
    assert [epoch["epoch"] for epoch in second["epochs"]] == [0, 1, 2]


def test_ctrl_c_leaves_a_summary_and_a_log_that_goes_on_and_no_process(start_demo: Callable[..., Demo]) -> None:
    demo = start_demo(*QUICK, "--trials", "100000")
    demo.wait_for("exact")
    members = demo.members()
    sent = time.monotonic()
    demo.process.send_signal(signal.SIGINT)
    demo.wait_until(lambda: not demo.processes.running(members))
    assert time.monotonic() - sent < 5.0  # that is the promise; then the figure is drawn
    status, result, _ = demo.finish()
    assert status == 130
    assert result["stopped_by"] == "SIGINT"
    assert result["trials"] > 0
    again = start_demo(*QUICK, "--trials", "10").result()
    assert again["trials"] == result["trials"]
    assert {epoch["balls"] for epoch in again["epochs"]} == {50}


def test_nothing_outlives_a_killed_demo(start_demo: Callable[..., Demo]) -> None:
    demo = start_demo(*QUICK, "--trials", "100000")
    demo.wait_for("exact")
    members = demo.members()
    assert len(members) >= 4
    demo.process.kill()
    demo.wait_until(lambda: not demo.processes.running(members))


def test_a_demo_goes_on_without_a_killed_worker_and_says_so(start_demo: Callable[..., Demo]) -> None:
    demo = start_demo(*QUICK, "--trials", "700")
    workers = demo.wait_until(lambda: named(demo, "spawn_main")[1:] and named(demo, "spawn_main"))
    os.kill(workers[0], signal.SIGKILL)
    result = demo.result()
    assert "was killed by SIGKILL; 1 of 2 go on" in demo.log.read_text()
    assert result["workers_lost"] == 1
    assert result["trials"] == 700


def test_a_demo_whose_server_dies_ends_everything_with_one_line(start_demo: Callable[..., Demo]) -> None:
    demo = start_demo(*QUICK, "--trials", "100000")
    demo.wait_for("exact")
    members = demo.members()
    os.kill(named(demo, " server ")[0], signal.SIGKILL)
    status, result, log = demo.finish()
    assert status == 1
    assert [line for line in log.splitlines() if line.startswith("error: ")] == [f"error: {result['problem']}"]
    assert "the server ended with status -9" in result["problem"]
    assert not demo.processes.running(members)


def test_a_demo_goes_on_without_a_dashboard_that_fails(start_demo: Callable[..., Demo], without_rerun: Path) -> None:
    demo = start_demo("--skill", "reaching:make", "--trials", "20", path=(without_rerun,))
    result = demo.result()
    assert "warning: the dashboard is gone (crkr watch needs the extra 'dashboard'" in demo.log.read_text()
    assert result["recording"] is None
    assert result["trials"] == 20


def test_a_demo_with_its_dashboard_says_where_to_look_and_records(start_demo: Callable[..., Demo]) -> None:
    demo = start_demo("--skill", "reaching:make", "--trials", "60")
    result = demo.result()
    assert "viewer: http://127.0.0.1:" in demo.log.read_text()
    assert Path(result["recording"]).read_bytes().startswith(b"RRF")


def test_a_taken_port_is_one_line(start_demo: Callable[..., Demo], free_port: int) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", free_port))
        other.listen()
        status, _, log = start_demo(*QUICK, "--port", str(free_port)).finish()
    assert status == 1
    assert log.splitlines()[-1].startswith("error: the server did not start: ")
    assert str(free_port) in log.splitlines()[-1]


def test_a_folder_that_cannot_be_made_is_one_line(start_demo: Callable[..., Demo], tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    status, _, log = start_demo(*QUICK, "--data", "taken").finish()
    assert status == 1
    assert log.splitlines()[-1].startswith("error: ")
    assert "taken" in log.splitlines()[-1]


def test_an_unknown_skill_is_one_line(start_demo: Callable[..., Demo]) -> None:
    status, _, log = start_demo("--skill", "tabel-tennis").finish()
    assert status == 1
    assert log.splitlines() == [
        "error: no skill 'tabel-tennis'; installed: table-tennis, throw; name your own as package.module:factory"
    ]
