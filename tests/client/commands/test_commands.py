"""The client's commands against a real server: what people read, what programs read, and the exit status."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from crkr.client import Client
from crkr.client.cli.subcommands import build

Run = Callable[..., Result]
SPEC = """
name = "{name}"
budget = 50
[[state]]
name = "distance"
unit = "m"
low = 0.0
high = 4.0
[[goal]]
name = "speed"
unit = "m/s"
low = 0.0
high = 8.0
[[goal]]
name = "angle"
low = -1.0
high = 1.0
"""
DEMONSTRATION = (
    "--state",
    "1.5",
    "--goal",
    "3 0.25",
    "--cost",
    "0.1",
    "--success",
    "--kind",
    "demonstration",
    "--wait",
)


@pytest.fixture
def task(run: Run, tmp_path: Path) -> str:
    name = f"throw-{uuid4()}"
    (tmp_path / "throw.toml").write_text(SPEC.format(name=name))
    assert run("create", str(tmp_path / "throw.toml")).stdout == f"created {name} (R^1 -> R^2)\n"
    run("report", name, *DEMONSTRATION)
    return name


def data(result: Result) -> Any:
    """The one JSON value on standard output."""
    assert result.stdout.count("\n") == 1
    return json.loads(result.stdout)


def test_a_task_is_created_once_and_listed(run: Run, task: str, tmp_path: Path) -> None:
    again = run("create", str(tmp_path / "throw.toml"), "--json")
    assert data(again) == {"name": task, "created": False}
    [listed] = [entry for entry in data(run("tasks", "--json")) if entry["spec"]["name"] == task]
    assert (listed["samples"], listed["active"], listed["spec"]["budget"]) == (1, 1, 50)
    assert any(line.split() == [task, "1", "2", "1", "1", "2"] for line in run("tasks").stdout.splitlines())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("budgte = 3\n" + SPEC, "budgte"),
        (SPEC.replace('"{name}"', "3"), "task name"),
        ("budget =\n" + SPEC, "is not TOML"),
    ],
)
def test_a_bad_specification_file_is_refused_with_the_reason(run: Run, tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    assert message in run("create", str(path), status=1).stderr


def test_a_specification_is_written_without_a_server_and_read_back_the_same(
    run: Run, task: str, tmp_path: Path, shared_endpoint: str
) -> None:
    written = tmp_path / "throw.json"
    words = ["create", str(tmp_path / "throw.toml"), "--write", str(written), "--connect", "tcp/127.0.0.1:1"]
    result = CliRunner().invoke(build(words), words)
    assert result.exit_code == 0, result.stderr
    assert f"crkr create {written}" in result.stdout
    assert run("create", str(tmp_path / "throw.toml"), "--write", "-").stdout == written.read_text()
    with Client(shared_endpoint, timeout_s=30.0) as client:
        assert json.loads(written.read_text()) == client.task(task).spec.to_dict()
    assert data(run("create", str(written), "--json")) == {"name": task, "created": False}
    written.write_text(written.read_text() + "?")
    assert "is not JSON" in run("create", str(written), status=1).stderr


@pytest.mark.parametrize(("name", "message"), [("throw.toml", "is written as JSON"), ("here.json", "is there already")])
def test_an_edited_file_is_not_written_over(run: Run, tmp_path: Path, name: str, message: str) -> None:
    source, target = tmp_path / "throw.toml", tmp_path / name
    source.write_text(SPEC.format(name="throw"))
    target.touch()
    before = target.read_bytes()
    assert message in run("create", str(source), "--write", str(target), status=1).stderr
    assert target.read_bytes() == before


def test_a_prediction_is_printed_by_name_and_as_json(run: Run, task: str) -> None:
    shown = run("predict", task, "--state", "1.5").stdout
    assert "speed  3" in shown
    assert "m/s" in shown
    answer = data(run("predict", task, "--state", "1.5", "--explore", "--json", "--id", str(UUID(int=5))))
    assert answer["trial_id"] == str(UUID(int=5))
    assert len(answer["goal"]) == len(answer["sigma"]) == 2
    assert (answer["policy"], answer["active"]) == ("explore", 1)
    said = run("predict", task, "--state", "40", "--json")
    assert said.stderr == "warning: distance is 40, outside its box of 0 to 4 m; goals there are guesses\n"
    assert data(said)["novelty"] > 0.99


def test_a_prediction_says_which_outcome_is_expected_of_the_goal(shared_endpoint: str, run: Run) -> None:
    name, rng = f"aim-{uuid4()}", np.random.default_rng(0)
    axis = {"low": -1.0, "high": 1.0}
    outcome = [{"name": n, "unit": "m", "target": 0.5, "tolerance": 0.1} for n in ("side", "far")]
    spec = {"name": name, "state": [{"name": "x", **axis}], "goal": [{"name": "g", **axis}], "outcome": outcome}
    states, goals = rng.uniform(-1, 1, (60, 1)), rng.uniform(-1, 1, (60, 1))
    measured = np.column_stack([goals + 0.5, np.full(60, np.nan)])
    with Client(shared_endpoint, timeout_s=30.0) as client:
        task = client.create_task(spec)
        task.report(state=states, goal=goals, cost=np.full(60, 0.5), success=True, outcome=measured, wait=True)
    shown = run("predict", name, "--state", "0").stdout.splitlines()
    [line] = [line.split() for line in shown if line.startswith("side")]
    assert (line[2], line[4:]) == ("m", ["0.5", "0.1"])
    answer = data(run("predict", name, "--state", "0", "--json"))
    assert answer["predicted_outcome"][0] == pytest.approx(answer["goal"][0] + 0.5, abs=0.05)
    assert answer["predicted_outcome"][1] is None  # never observed


def test_hit_and_miss_are_enough_where_a_task_learns_from_labels(run: Run, tmp_path: Path) -> None:
    name = f"toss-{uuid4()}"
    path = tmp_path / "toss.toml"
    path.write_text('cost = "label"' + SPEC.format(name=name))
    run("create", str(path))
    for label in ("--hit", "--miss"):
        run("report", name, "--state", "1.5", "--goal", "3 0.25", label, "--wait")
    answer = data(run("predict", name, "--state", "1.5", "--json"))
    assert answer["active"] == 1
    assert 0.0 < answer["success_probability"] < 1.0
    assert "succeeds with probability" in run("predict", name, "--state", "1.5").stdout


def test_a_report_tells_new_from_known(run: Run, task: str) -> None:
    trial = ["--state", "2", "--goal", "4, -0.5", "--cost", "0.2", "--failure", "--id", str(uuid4())]
    assert run("report", task, *trial, "--wait").stdout.startswith("stored: number 3")
    assert trial[-1] in run("report", task, *trial).stdout
    assert run("report", task, *trial).stdout.startswith("known already: number 3")
    failed = data(run("report", task, "--state", "2", "--goal", "4 0", "--failure", "--kind", "failed", "--json"))
    assert (failed["accepted"], failed["seqs"]) == (1, [4])
    assert data(run("remove", task, *failed["ids"], "--json"))["removed"] == 1


def test_an_explanation_names_the_samples(run: Run, task: str) -> None:
    answer = data(run("explain", task, "--state", "1.5", "--json"))
    [neighbour] = answer["neighbours"]
    assert neighbour["distance"] == 0
    assert answer["grounds"] == {
        "policy": "mean",
        "samples": 1,
        "success_probability": None,
        "tried": 0,
        "succeeded": 0,
    }
    text = run("explain", task, "--state", "1.5", "--sample", neighbour["id"]).stdout
    assert f"{neighbour['id']} is in the model; no sample near it is better" in text
    assert text.startswith("The goal is the mean of 1 sample, the nearest 0 length-scales away.")


def test_the_status_is_shown_by_verb_and_probed_by_exit_code(run: Run, task: str, free_port: int) -> None:
    assert data(run("status", task, "--json"))["samples"]["demonstration"] == 1
    shown = run("status", task).stdout
    assert "samples.demonstration" in shown
    assert [line.split()[0] for line in shown.splitlines()[:2]] == ["task", "success"]
    assert "no trial yet" in shown
    assert "no workers seen" in shown
    assert "length-scale of distance" in shown
    assert "protocol" in run("status").stdout
    assert run("status", "--check").stdout == ""
    assert run("status", task, "--check").stdout == ""
    assert run("status", "no-such-task", "--check", status=1).output == ""
    assert "no task" in run("status", "no-such-task", status=1).stderr
    words = ["status", "--check", "--connect", f"tcp/127.0.0.1:{free_port}", "--timeout", "0.2"]
    result = CliRunner().invoke(build(words), words)
    assert result.exit_code == 1
    assert result.output == ""


def test_the_status_of_a_task_says_first_how_well_it_learns_and_what_limits_it(
    run: Run, task: str, shared_endpoint: str
) -> None:
    rng = np.random.default_rng(2)
    with Client(shared_endpoint, timeout_s=30.0) as client:
        for won in (False, True):
            states, goals = rng.uniform(0.1, 3.9, (200, 1)), rng.uniform([1, -0.5], [7, 0.5], (200, 2))
            success = [won and number % 2 > 0 for number in range(200)]
            client.task(task).report(state=states, goal=goals, cost=np.full(200, 0.5), success=success, wait=True)
    first, second, third, *_ = run("status", task).stdout.splitlines()[:3]
    assert first.startswith("task")
    assert "50% (43% to 57%) of the newest 200 trials, up from 0% in the 200 before" in second
    assert third.startswith("advice")
    assert "declare an outcome" in third
    assert data(run("status", task, "--json"))["advice"][0]["code"] == "no_outcome"


def test_a_task_is_managed(run: Run, task: str) -> None:
    [sample] = data(run("explain", task, "--state", "1.5", "--json"))["neighbours"]
    assert data(run("recost", task, f"{sample['id']}=0.5", "--reason", "camera", "--json"))["changed"] == 1
    changed = data(run("configure", task, "budget=9", "cost_map=odds", "kernel.linear_weight=0.5", "--json"))["spec"]
    assert (changed["budget"], changed["cost_map"], changed["kernel"]["linear_weight"]) == (9, "odds", 0.5)
    assert run("configure", task, "budget=7", "kernel.linear_weight=0.25").stdout.splitlines() == [
        "kernel.linear_weight 0.5 -> 0.25",
        "budget 9 -> 7",
    ]
    assert run("configure", task, "budget=7").stdout == "nothing changed\n"
    assert "accepted" in data(run("refit", task, "--json"))
    fitted = dict(line.split(": ") for line in run("refit", task).stdout.splitlines())
    assert fitted["accepted"] in ("yes", "no")
    assert len(fitted["signal variance"]) <= len("-1.234e-05")
    assert "removed: 1" in run("remove", task, sample["id"]).stdout
    assert "archived: yes" in run("archive", task, "--yes").stdout
    assert "archived" in run("report", task, *DEMONSTRATION, status=1).stderr


def test_new_settings_are_shown_beside_the_numbers_that_a_fit_put_in_force(
    run: Run, task: str, shared_endpoint: str
) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        states = np.linspace(0.1, 3.9, 40)[:, None]
        goals = np.hstack([4 + 2 * np.sin(states), 0.5 * np.cos(states)])
        client.task(task).report(state=states, goal=goals, cost=np.full(40, 0.1), success=True, wait=True)
    fit = data(run("refit", task, "--json"))
    assert fit["accepted"] is True
    shown = run("configure", task, "budget=45").stdout.splitlines()
    assert shown[0] == "budget 50 -> 45"
    assert shown[1] == f"in force: lengthscales {fit['lengthscales'][0]:.4g}, fitted (the specification says 1)"
    assert shown[2].startswith(f"in force: signal_variance {fit['signal_variance']:.4g}, fitted")
    assert data(run("configure", task, "budget=44", "--json"))["hyperparameters"]["lengthscales"] == fit["lengthscales"]


def test_an_archived_task_is_listed_as_such(run: Run, task: str, shared_endpoint: str) -> None:
    listed = {entry["spec"]["name"]: entry for entry in data(run("tasks", "--json"))}
    assert listed[task]["archived"] is False
    run("archive", task, "--yes")
    with Client(shared_endpoint, timeout_s=30.0) as client:
        assert [entry["archived"] for entry in client.tasks() if entry["spec"].name == task] == [True]
    assert any(line.split() == [task, "1", "2", "1", "1", "3", "archived"] for line in run("tasks").stdout.splitlines())


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("predict", ["throw", "--state", "one"], "--state"),
        ("explain", ["throw", "--state", "1", "--sample", "5"], "UUID"),
        ("recost", ["throw", "12"], "UUID"),
        ("recost", ["throw", f"{UUID(int=1)}=much"], "ID=COST"),
        ("configure", ["throw", "budget"], "KEY=VALUE"),
        ("create", [], "--skill"),
        ("create", [__file__, "--preset", "tuned"], "--skill"),
        ("predict", ["throw"], "--state"),
        ("status", ["--timeout", "0"], "--timeout"),
    ],
)
def test_wrong_usage_exits_with_2_and_says_how(run: Run, command: str, arguments: list[str], message: str) -> None:
    assert message in run(command, *arguments, status=2).stderr


def test_archiving_asks_first(run: Run, task: str) -> None:
    assert f"crkr archive {task} --yes" in run("archive", task, status=1).stderr
    assert data(run("status", task, "--json"))["archived"] is False


def test_the_doctor_finds_nothing_wrong_with_a_healthy_server(run: Run, tmp_path: Path) -> None:
    report = data(run("doctor", "--data", str(tmp_path), "--json"))
    assert report["ok"] is True
    assert {entry["check"] for entry in report["checks"]} >= {
        "versions", "endpoint", "reachable", "protocol", "round trip", "disk", "commit",
    }  # fmt: skip


def test_the_doctor_says_what_is_wrong(run: Run, free_port: int, tmp_path: Path) -> None:
    missing = data(run("doctor", "--data", str(tmp_path / "absent"), "--json", status=1))
    assert [entry["check"] for entry in missing["checks"] if not entry["ok"]] == ["disk"]
    words = ["doctor", "--connect", f"tcp/127.0.0.1:{free_port}", "--timeout", "0.2"]
    result = CliRunner().invoke(build(words), words)
    assert result.exit_code == 1
    assert "FAILED" in result.stdout
    assert str(free_port) in result.stdout
    assert "start one: crkr server" in result.stdout
    assert "doctor" not in result.stdout


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("predict", ["--state", "1 2"], "--state takes 1 number, (distance); got 2"),
        ("explain", ["--state", "1 2"], "--state takes 1 number, (distance); got 2"),
        ("report", ["--state", "1", "--goal", "3", "--success"], "--goal takes 2 numbers, (speed, angle); got 1"),
    ],
)
def test_a_wrong_count_of_numbers_is_refused_by_the_coordinates_names(
    run: Run, task: str, command: str, arguments: list[str], message: str
) -> None:
    assert run(command, task, *arguments, status=1).stderr == f"error: {message}\n"


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"PYTHONIOENCODING": "latin-1"},
        {"OMP_NUM_THREADS": "many", "PYTHONWARNINGS": "error"},
    ],
    ids=lambda environment: next(iter(environment.values())),
)
def test_help_is_printed_whatever_the_environment_says(environment: dict[str, str]) -> None:
    command = [sys.executable, "-m", "crkr.client", "trials", "--help"]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"--worst" in done.stdout
