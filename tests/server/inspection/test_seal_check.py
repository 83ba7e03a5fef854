"""A long log is looked over row by row after the start: damage that no prediction rests on is found and told too."""

import json
import os
import queue
import sqlite3
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import pytest
from processes import Processes

from crkr.protocol import StorageError, TaskSpec
from crkr.server.inspection.seal_check import SealCheck
from crkr.server.inspection.synthetic_log import fill
from crkr.server.log import read_log

Ask = Callable[..., dict[str, Any]]
COUNT = 5200  # the rows of shorter logs are read whole as the server starts
DAMAGES = (
    "worker = 'eve'",
    "time = time + 1",
    "info = x'80'",
    "removed = 1",
    "present_cost = 0.5",
    "model_version = 7",
)


@pytest.fixture
def long_log(tmp_path: Path, reach: dict[str, Any]) -> Path:
    """Its data directory."""
    fill(tmp_path / "data", TaskSpec.from_dict(reach), COUNT)
    return tmp_path / "data"


def damage(data: Path, change: str, where: int) -> None:
    with closing(sqlite3.connect(data / "crkr.sqlite3", isolation_level=None)) as database:
        database.execute(f"UPDATE trial SET {change} WHERE seq = {where}")


def checking(pid: int) -> list[int]:
    """Processes that any thread of this one has started."""
    found: list[int] = []
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):  # it ended just now
            found += [int(word) for word in (thread / "children").read_text().split()]
    return found


def test_every_column_of_every_row_is_looked_at(long_log: Path) -> None:
    reader = read_log(long_log / "crkr.sqlite3")
    reader.check("reach", COUNT + 1)
    for place, change in enumerate(DAMAGES):
        where = COUNT + 1 - 1000 * place
        damage(long_log, change, where)
        reader.check("reach", where - 1)
        with pytest.raises(StorageError, match=f"log position {where} does not match"):
            reader.check("reach", COUNT + 1)
    reader.close()


def test_a_row_that_is_not_as_it_was_stored_is_told_and_the_server_goes_on(
    long_log: Path,
    start_server: Callable[..., Any],
    free_port: int,
    connect: Callable[[str], Ask],
    processes: Processes,
) -> None:
    damage(long_log, DAMAGES[0], 4321)
    server = start_server("--metrics", str(free_port), data=long_log)
    ask = connect(server.endpoint)
    before = ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})
    status = processes.wait_until(lambda: (found := ask("task/reach/rpc/status")).get("damage") and found, server.log)
    assert "log position 4321 does not match its digest" in status["damage"]
    assert f"task reach: {status['damage']}" in server.log.read_text()
    words = [sys.executable, "-m", "crkr.client", "status", "reach", "--connect", server.endpoint]
    shown = subprocess.run(
        words, capture_output=True, text=True, timeout=30.0, check=True, env={**os.environ, "COLUMNS": "300"}
    )
    assert "log position 4321 does not match its digest" in shown.stdout
    with urllib.request.urlopen(f"http://127.0.0.1:{free_port}/metrics", timeout=10) as page:
        assert 'crkr_task_damaged{task="reach"} 1.0' in page.read().decode()
    after = ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})
    assert (after["means"], after["active"]) == (before["means"], 20)
    processes.wait_until(lambda: not checking(server.process.pid))


def test_a_whole_log_is_found_whole_and_a_server_may_end_meanwhile(
    long_log: Path, start_server: Callable[..., Any], connect: Callable[[str], Ask], processes: Processes
) -> None:
    server = start_server(data=long_log)
    child = processes.wait_until(lambda: checking(server.process.pid), server.log)
    server.process.terminate()
    assert server.process.wait(60) == 0
    assert not processes.running(child)
    server = start_server(data=long_log)
    processes.wait_until(lambda: "task reach: every row is intact" in server.log.read_text(), server.log)
    assert "damage" not in connect(server.endpoint)("task/reach/rpc/status")
    assert "Traceback" not in server.log.read_text()


def test_what_cannot_be_looked_over_is_no_damage(long_log: Path, free_port: int) -> None:
    away = f"postgresql://crkr@127.0.0.1:{free_port}/crkr"
    words = [sys.executable, "-m", "crkr.server.inspection.seal_check"]
    for where, says, status in ((str(long_log), '["reach", ""]\n', 0), (away, "", 1)):
        asked = json.dumps([where, {"gone": 7, "reach": COUNT + 1}])
        done = subprocess.run(words, input=asked, capture_output=True, text=True, timeout=60, check=False)
        assert (done.stdout, done.returncode) == (says, status)
        assert "Traceback" not in done.stderr


def test_files_in_the_working_directory_are_not_taken_for_modules(
    long_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    damage(long_log, DAMAGES[0], 4321)
    (tmp_path / "sqlite3.py").write_text("raise SystemExit(3)\n")
    monkeypatch.chdir(tmp_path)
    told: queue.Queue[tuple[str, str]] = queue.Queue()
    check = SealCheck(str(long_log), {"reach": COUNT + 1}, lambda *damage: told.put(damage))
    check.start()
    try:
        task, what = told.get(timeout=60)
    finally:
        check.stop()
    assert task == "reach"
    assert "log position 4321" in what
