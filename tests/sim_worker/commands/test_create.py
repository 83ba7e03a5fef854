"""`crkr create --skill`: a skill's task without workers, and its specification to edit for them."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from crkr.client import Client, Task
from crkr.protocol import TaskSpec

Start = Callable[..., Any]
TABLE_TENNIS = ("create", "--skill", "table-tennis")
# An interpreter in which one library of the extra is not installed.
WITHOUT = """
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
sys.argv = ["crkr", *{words!r}]
from crkr.client.cli.main import main
main()
"""


@pytest.fixture
def train(start_command: Start, task: Task, shared_endpoint: str) -> Start:
    """Runs one worker for ten trials on the test's task."""

    def start(*words: str) -> Any:
        options = ["--task", task.name, "--connect", shared_endpoint, "--trials", "10", "--evaluations", "0", "--json"]
        return start_command("workers", "reaching:make", *options, *words)

    return start


def test_the_task_of_a_built_in_skill_is_made_as_its_workers_would_make_it(
    start_command: Start, client: Client, task: Task, shared_endpoint: str
) -> None:
    words = ("--preset", "paper", "--launcher", "wide", "--task", task.name, "--connect", shared_endpoint)
    status, output, log = start_command(*TABLE_TENNIS, *words).finish()
    assert (status, output) == (0, f"created {task.name} (R^6 -> R^13)\n"), log
    assert task.spec.exploration.type == "gaussian"
    assert sum(task.status()["samples"].values()) == 0
    again = start_command(*TABLE_TENNIS, *words, "--json").result()
    assert again == {"name": task.name, "created": False}
    workers = ("workers", "table-tennis", "--trials", "0", "--evaluations", "0")
    assert start_command(*workers, *words, "--json").result()["demonstrations"] == 5


def test_a_specification_that_was_edited_is_what_workers_train_under(
    start_command: Start, train: Start, task: Task, shared_endpoint: str, tmp_path: Path
) -> None:
    path = tmp_path / "spec.json"
    words = ("--skill", "reaching:make", "--task", task.name)
    status, _, log = start_command("create", *words, "--write", str(path), "--connect", "tcp/127.0.0.1:1").finish()
    assert status == 0, log
    edited = json.loads(path.read_text())
    edited["budget"], edited["state"][0]["lengthscale"] = 33, 0.7
    path.write_text(json.dumps(edited))
    status, _, log = start_command("create", str(path), "--connect", shared_endpoint).finish()
    assert status == 0, log
    command = train()
    assert command.result()["trained"] == 10
    assert f"task {task.name} exists and keeps its own budget" in command.log.read_text()
    assert task.spec == TaskSpec.from_dict(edited)
    status, _, log = train("--preset", "plain").finish()
    assert status == 1
    assert "these fields differ: budget" in log.splitlines()[-1]


def test_workers_refuse_a_task_whose_goals_lie_elsewhere(
    client: Client, start_command: Start, train: Start, task: Task
) -> None:
    status, output, log = start_command(
        "create", "--skill", "reaching:make", "--task", task.name, "--write", "-"
    ).finish()
    assert status == 0, log
    data = json.loads(output)
    data["goal"][1]["high"] = 2.0
    client.create_task(data)
    status, _, log = train().finish()
    assert status == 1
    assert "these fields differ: goal" in log.splitlines()[-1]


@pytest.mark.parametrize("package", ["mujoco", "scipy"])
def test_without_the_extra_one_line_says_what_to_install(package: str) -> None:
    code = WITHOUT.format(package=package, words=[*TABLE_TENNIS, "--write", "-"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: crkr create --skill needs the extra 'sim': pip install 'crkr[sim]'\n"


def test_an_unknown_skill_is_one_line(start_command: Start) -> None:
    status, _, log = start_command("create", "--skill", "tabel-tennis").finish()
    assert status == 1
    assert log.startswith("error: no skill 'tabel-tennis'; installed: table-tennis")
