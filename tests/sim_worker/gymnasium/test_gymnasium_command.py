"""`crkr workers gymnasium:ENV-ID`, and the example, against a real server."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from processes import RunningServer

from crkr.client import Client
from crkr.sim_worker import SkillOptions, load_skill

REPOSITORY = Path(__file__).parents[3]


def crkr(*words: str, endpoint: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "crkr.client", *words, "--connect", endpoint]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=False, cwd=REPOSITORY)


def test_workers_learn_an_environment_from_its_name(server: RunningServer) -> None:
    asked = ["workers", "gymnasium:FetchReach-v4", "--trials", "40", "--evaluations", "0", "--seed", "1", "--json"]
    done = crkr(*asked, endpoint=server.endpoint)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["trials"] == 40
    with Client(server.endpoint) as client:
        task = client.task("fetchreach-v4")
        assert task.spec.description == "Gymnasium's FetchReach-v4; success is is_success."
        kept = [stored.trial for stored in task.iter_samples()]
    assert len(kept) == 40
    assert any(trial.success for trial in kept)
    assert all(trial.outcome is not None for trial in kept)


def test_the_example_runs_by_several_workers(server: RunningServer) -> None:
    words = [
        "workers",
        "examples/gymnasium_reacher.py:make",
        "-n",
        "2",
        "--trials",
        "60",
        "--evaluations",
        "0",
        "--json",
    ]
    done = crkr(*words, endpoint=server.endpoint)
    assert done.returncode == 0, done.stderr
    with Client(server.endpoint) as client:
        assert [axis.name for axis in client.task("reacher-v5").spec.goal] == ["joint0", "joint1"]


def test_an_environment_that_is_not_there_is_told_in_one_line(server: RunningServer) -> None:
    done = crkr("workers", "gymnasium:Flying-v0", endpoint=server.endpoint)
    assert done.returncode == 1
    error = done.stderr.strip().splitlines()[-1]
    assert error.startswith("error: there is no environment 'Flying-v0': Environment `Flying` doesn't exist")
    assert "Traceback" not in done.stderr


def test_the_program_of_the_page_makes_the_skill_of_the_example() -> None:
    (program,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs" / "gymnasium.md").read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(compile(program, "gymnasium.md", "exec"), names)
    options = SkillOptions()
    assert (
        names["make"](options).spec() == load_skill(f"{REPOSITORY}/examples/gymnasium_reacher.py:make", options).spec()
    )
