"""Trials that are looked at, corrected and tried by hand, as people do it at a terminal."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from typer.testing import Result

from crkr.client import Client

Run = Callable[..., Result]
AXIS = {"low": 0.0, "high": 4.0}
SPEC: dict[str, Any] = {
    "state": [{"name": "distance", "unit": "m", **AXIS}],
    "goal": [{"name": "speed", "unit": "m/s", **AXIS}],
    "outcome": [{"name": "short", "unit": "m", "tolerance": 0.1}],
    "exploration": {"type": "gaussian"},
}


@pytest.fixture
def task(shared_endpoint: str, run: Run) -> str:
    """A task that a worker and a person reported trials of."""
    name = f"throw-{uuid4()}"
    with Client(shared_endpoint, timeout_s=30.0) as client:
        made = client.create_task({"name": name, **SPEC})
        for number in range(12):
            trial: dict[str, Any] = {"state": [number / 4], "goal": [number / 4], "cost": number / 20}
            made.report(**trial, success=True, worker="w" if number < 6 else None, id=UUID(int=number + 1), wait=True)
    return name


def listed(run: Run, task: str, *options: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(run("trials", task, *options, "--json").stdout)
    return found


def test_the_newest_the_worst_and_a_named_trial_are_listed(run: Run, task: str) -> None:
    assert [one["seq"] for one in listed(run, task)] == list(range(13, 3, -1))
    assert [one["cost"] for one in listed(run, task, "--worst", "--last", "3")] == [0.55, 0.5, 0.45]
    [named] = listed(run, task, "--id", str(UUID(int=3)))
    assert named["cost"] == 0.1
    shown = run("trials", task, "--last", "2").stdout.splitlines()
    assert [line.split()[:2] for line in shown[1:]] == [["13", str(UUID(int=12))], ["12", str(UUID(int=11))]]
    assert "distance 0.5 m" in run("trials", task, "--id", str(UUID(int=3))).stdout
    assert "no trial with this id" in run("trials", task, "--id", str(uuid4()), status=1).stderr


def test_a_trial_is_amended_and_the_correction_taken_back(run: Run, task: str) -> None:
    one = str(UUID(int=12))
    assert "changed: 1" in run("amend", task, one, "--miss", "--cost", "0.9", "--outcome", "nan").stdout
    [amended] = listed(run, task, "--last", "1")
    assert (amended["success"], amended["cost"], amended["outcome"]) == (False, 0.9, [None])
    assert "changed: 0" in run("amend", task, one, "--miss").stdout
    assert "the amend of 1 trial at number 14" in run("undo", task).stdout
    assert listed(run, task, "--last", "1")[0]["success"] is True
    assert "the trial at number 13" in run("undo", task).stdout
    assert "removed" in run("trials", task, "--last", "1").stdout
    assert "amend it with restore" in run("amend", task, one, "--hit", status=1).stderr
    assert json.loads(run("undo", task, "--worker", "w", "--json").stdout)["undone_seq"] == 7
    assert "nothing to amend" in run("amend", task, one, status=1).stderr


def test_a_person_tries_goals_and_says_which_hit(run: Run, task: str) -> None:
    typed = "1.5|h||" + "|h 0.3|0.25|" + "oops|2.0|what|m 7|m 0,3|m 0.3 0.5|m||" + "1|s|" + "1|f|" + "u|1|h||" + "1|q|"
    shown = run("ask", task, typed=typed.replace("|", "\n"))
    trials = listed(run, task, "--last", "5")
    assert [(one["kind"], one["success"], one["cost"]) for one in trials[:4]] == [
        ("trial", True, 0.1), ("failed", False, None), ("trial", False, 0.9), ("trial", True, 0.3),
    ]  # fmt: skip
    assert trials[1]["removed"] is True
    assert trials[3]["outcome"] == [0.25]
    assert trials[3]["state"] == [1.5]
    assert "4 trials" in shown.stdout
    assert str(trials[0]["id"]) in shown.stdout
    assert "cost must be" in shown.stderr
    assert "as 0.1 0.2; got 'oops'" in shown.stderr
    assert shown.stderr.count("the cost is one number, as in h 0.3") == 2


def test_asking_ends_with_the_input_and_reports_nothing_of_the_open_trial(run: Run, task: str) -> None:
    shown = run("ask", task, "--state", "1.0", "--best", typed="h\n\nm\n")
    assert "1 hits in 1 trials" in shown.stdout
    assert listed(run, task, "--last", "1")[0]["seq"] == 14
    assert "takes 1 number" in run("ask", task, "--state", "1 2", typed="", status=1).stderr


def test_what_another_person_reported_does_not_count_when_taken_back(shared_endpoint: str, task: str) -> None:
    command = [sys.executable, "-m", "crkr.client", "ask", task, "--state", "1.0", "--connect", shared_endpoint]
    pipe = subprocess.PIPE
    with (
        Client(shared_endpoint, timeout_s=30.0) as client,
        subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as asking,
    ):
        assert asking.stdin is not None
        assert asking.stdout is not None
        asking.stdin.write("h\n\n")
        asking.stdin.flush()
        assert next(line for line in asking.stdout if "hit: number 14" in line)
        client.task(task).report(state=[1.0], goal=[1.0], cost=0.5, success=True, wait=True)
        shown, _ = asking.communicate("u\nq\n", timeout=20.0)
    assert "taken back: the trial at number 15" in shown
    assert "1 hits in 1 trials" in shown


def test_a_state_that_the_task_refuses_is_an_error_where_it_is_that_of_all_trials(
    run: Run, shared_endpoint: str
) -> None:
    name = f"throw-{uuid4()}"
    with Client(shared_endpoint, timeout_s=30.0) as client:
        made = client.create_task({"name": name, **SPEC, "novel": "refuse", "novelty_limit": 0.5})
        made.report(state=[[0.1]] * 3, goal=[[1.0]] * 3, cost=0.1, success=True, wait=True)
    assert "refuses" in run("ask", name, "--state", "50", typed="", status=1).stderr
    assert "refuses" in run("ask", name, typed="50\nq\n").stderr


def test_the_page_about_trials_runs_as_it_is_printed(
    run: Run, shared_endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[3] / "docs" / "trials.md").read_text()
    specification, commands, program = re.findall(r"```(?:toml|sh|python)\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("toss.toml").write_text(specification)
    lines = [shlex.split(line, comments=True) for line in commands.splitlines()]
    assert [line[:2] for line in lines].count(["crkr", "undo"]) == 2
    for _, command, *words in lines:
        run(command, *words, typed="2.0\nh\nq\n" if command == "ask" else None)
    with Client(shared_endpoint, timeout_s=30.0) as client:
        task = client.task("toss")
        assert [(one.trial.success, one.removed) for one in task.trials()] == [(True, False), (True, False)]
    exec(compile(program.replace("tcp/127.0.0.1:7447", shared_endpoint), "trials.md", "exec"), {})
    assert capsys.readouterr().out == "False amend\n"
