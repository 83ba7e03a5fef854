"""Logs of the version before that hold what is refused now: each task is served, or says alone why it cannot be."""

from __future__ import annotations

import gzip
import json
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crkr.protocol import StorageError, TaskSpec
from crkr.server.learning.restore import restore_all
from crkr.server.log import SqliteLog

Ask = Callable[..., dict[str, Any]]
Connect = Callable[[str], Ask]
Numbers = Callable[[Any], np.ndarray[Any, Any]]

STORED = Path(__file__).with_name("data")  # made by version 0.1.0
AXIS = [{"name": "x", "low": -1.0, "high": 1.0}]
FAULTY = "large-box"  # its log holds a fit with an infinite length-scale


@pytest.fixture
def laid_out(tmp_path: Path) -> Callable[[str], Path]:
    """A data directory with one of the stored logs."""

    def lay_out(name: str) -> Path:
        data = tmp_path / name
        data.mkdir()
        (data / "crkr.sqlite3").write_bytes(gzip.decompress((STORED / f"{name}.log.gz").read_bytes()))
        return data

    return lay_out


def crkr(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "crkr.client", *arguments], check=False, capture_output=True, text=True, timeout=60
    )


@pytest.fixture
def served(laid_out: Callable[[str], Path], start_server: Callable[..., Any]) -> Callable[[str], Any]:
    return lambda name: start_server(data=laid_out(name))


def test_numbers_that_are_refused_now_are_served_where_an_earlier_version_let_them_in(
    served: Callable[[str], Any], connect: Connect, numbers: Numbers
) -> None:
    ask = connect(served("numbers").endpoint)
    for name in ("fine", "small-variance", "large-budget", "full"):
        answer = ask(f"task/{name}/rpc/predict", {"states": [0.4], "explore": True})
        assert (np.abs(numbers(answer["goals"])) <= 1.0).all()
        assert "fault" not in ask(f"task/{name}/rpc/status")
    assert ask("task/large-budget/admin/configure", {"changes": {"refit_every": 50}})["spec"]["budget"] == 60_000
    again = {"name": "large-budget", "state": AXIS, "goal": AXIS, "budget": 100_000}
    assert ask("rpc/create_task", again)["created"] is False


def test_a_task_that_cannot_be_restored_leaves_the_others_as_they_were(
    served: Callable[[str], Any], connect: Connect
) -> None:
    endpoint = served("numbers").endpoint
    ask = connect(endpoint)
    assert ask("task/fine/rpc/report", {"trials": [trial(90)], "wait": True})["accepted"] == 1
    told = ask(f"task/{FAULTY}/rpc/status")["fault"]
    assert "lengthscales must be finite" in told
    assert ask("rpc/info")["faulty"] == {FAULTY: told}
    [listed] = [one for one in ask("rpc/tasks")["tasks"] if one["spec"]["name"] == FAULTY]
    assert listed["fault"] == told
    ids = [bytes(15) + b"\1"]
    for key, message in {
        "rpc/predict": {"states": [0.1]},
        "rpc/report": {"trials": [trial(91)]},
        "rpc/model": {},
        "rpc/explain": {"state": [0.1]},
        "admin/refit": {},
        "admin/remove": {"ids": ids},
        "admin/configure": {"changes": {"budget": 9}},
        "admin/archive": {},
    }.items():
        error = ask(f"task/{FAULTY}/{key}", message)["error"]
        assert error["code"] == "INTERNAL"
        assert told in error["message"]
        assert error["details"]["task"] == FAULTY
    assert told in ask("rpc/create_task", {"name": FAULTY, "state": AXIS, "goal": AXIS})["error"]["message"]
    assert len(ask(f"task/{FAULTY}/rpc/samples", {"after": 0})["samples"]) == 3


def test_the_commands_tell_of_a_task_that_cannot_be_restored_and_export_what_it_holds(
    served: Callable[[str], Any], tmp_path: Path
) -> None:
    server = served("numbers")
    where = ("--connect", server.endpoint)
    assert "lengthscales must be finite" in " ".join(crkr("status", FAULTY, *where).stdout.split())
    assert "faulty" in crkr("tasks", *where).stdout
    doctor = crkr("doctor", "--json", *where)
    assert doctor.returncode == 1
    [check] = [one for one in json.loads(doctor.stdout)["checks"] if not one["ok"]]
    assert FAULTY in check["detail"]
    file = tmp_path / "kept.csv"
    assert crkr("export", FAULTY, str(file), *where).returncode == 0
    assert len(file.read_text().splitlines()) == 4
    assert f"task {FAULTY} is not served" in server.log.read_text()


def test_a_replay_names_the_task_that_cannot_be_restored_and_looks_at_the_others(
    laid_out: Callable[[str], Path],
) -> None:
    replay = crkr("replay", "--json", str(laid_out("numbers")))
    assert replay.returncode == 1
    found = json.loads(replay.stdout)
    assert [problem.split(":")[0] for problem in found["problems"]] == [FAULTY]
    assert len(found["tasks"]) == 5


def test_a_faulty_task_keeps_its_log_position(laid_out: Callable[[str], Path]) -> None:
    log = SqliteLog(laid_out("numbers"))
    try:
        tasks = {task.name: task for task in restore_all(log.reads)}
    finally:
        log.close()
    assert [name for name, task in tasks.items() if task.fault] == [FAULTY]
    assert not tasks[FAULTY].restored
    assert tasks[FAULTY].seq == 5


def test_unknown_fields_and_arrays_that_an_earlier_version_stored_are_read(
    served: Callable[[str], Any], connect: Connect, numbers: Numbers
) -> None:
    ask = connect(served("unknown-fields").endpoint)
    answer = ask("task/fine/rpc/predict", {"states": [0.4]})
    assert answer["model_version"] == 14
    assert ask("task/fine/rpc/status")["hyperparameters"]["signal_variance"] == 9.0
    ask = connect(served("arrays-in-info").endpoint)
    assert ask("task/fine/rpc/predict", {"states": [0.4]})["active"] == 8
    infos = [one["info"]["value"] for one in ask("task/fine/rpc/samples", {"after": 5})["samples"]]
    np.testing.assert_array_equal(numbers(infos[0]), [1.5, 2.0])
    assert len(infos) == 4


def test_an_event_that_no_version_knew_makes_its_own_task_faulty_only(laid_out: Callable[[str], Path]) -> None:
    data = laid_out("arrays-in-info")
    log = SqliteLog(data)
    try:
        log.create(TaskSpec.from_dict({"name": "other", "state": AXIS, "goal": AXIS}))
        log.append_event("fine", "dream", {"of": "sheep"})
        faults = {task.name: task.fault for task in restore_all(log.reads)}
    finally:
        log.close()
    assert "'dream'" in faults["fine"]
    assert faults["other"] == ""


def test_a_specification_that_cannot_be_read_makes_its_own_task_faulty_only(laid_out: Callable[[str], Path]) -> None:
    log = SqliteLog(laid_out("arrays-in-info"))
    try:
        spec = TaskSpec.from_dict({"name": "other", "state": AXIS, "goal": AXIS})
        object.__setattr__(spec, "selector", "of a later version")
        log.create(spec)
        tasks = {task.name: task for task in restore_all(log.reads)}
    finally:
        log.close()
    assert "selector" in tasks["other"].fault
    assert tasks["fine"].fault == ""


def test_damage_to_a_stored_task_is_still_everyones(laid_out: Callable[[str], Path]) -> None:
    log = SqliteLog(laid_out("numbers"))
    try:
        with closing(sqlite3.connect(log.path)) as other, other:
            other.execute("UPDATE event SET body = x'80' WHERE kind = 'fit'")
        with pytest.raises(StorageError, match="does not match its digest"):
            restore_all(log.reads)
    finally:
        log.close()


def trial(number: int) -> dict[str, Any]:
    return {
        "id": bytes([*bytes(14), 7, number]),
        "state": [0.1],
        "goal": [0.2],
        "cost": 0.1,
        "success": True,
        "kind": "trial",
    }
