"""A skill of the user: made by `crkr new`, checked by `crkr check-skill`, run, changed and run again."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from crkr.client import Client
from crkr.protocol import Invalid, TaskSpec, UnknownTask
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.skill_check import check, problems
from crkr.sim_worker.skill_registry import portable_name, skill_of

Crkr = Callable[..., subprocess.CompletedProcess[str]]

FAULTY = """
import numpy as np
from crkr.sim_worker.skill import Demonstration, Geom, TaskSpec, Trace, TrialResult

class Faulty:
    def __init__(self, options):
        axis = {{"low": 0.0, "high": 1.0}}
        outcome = [{{"name": "miss", "tolerance": 0.1}}]
        self.x = 0.5
        self.own = TaskSpec.from_dict(
            {{"name": "odd", "state": [{{"name": "x", **axis}}], "goal": [{{"name": "g", **axis}}], "outcome": outcome}}
        )

    def spec(self):
        return self.own

    def reset(self, rng):
        self.x = rng.uniform()
        return np.array([{state}])

    def execute(self, goal):
        {execute}
        return TrialResult({cost}, abs(goal[0] - self.x) < 0.1, True, np.array([{outcome}]), trace={trace})

    def scene(self):
        return {scene}

make = Faulty
"""
FINE = {
    "state": "self.x",
    "execute": "pass",
    "cost": "0.1 + 0.8 * min(abs(goal[0] - self.x), 1.0)",
    "outcome": "goal[0] - self.x",
    "trace": "Trace(np.zeros(1), ('a',), np.zeros((1, 1, 3)), np.zeros((1, 1, 4)))",
    "scene": "[Geom('a', 'sphere', (0.1, 0.0, 0.0))]",
}


@pytest.fixture
def crkr(tmp_path: Path) -> Crkr:
    """Runs a command in an empty folder."""

    def run(*words: str, status: int = 0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "crkr.client", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100)
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return run


def test_a_new_skill_is_checked_tested_trained_and_judged_as_it_is_written(
    crkr: Crkr, tmp_path: Path, shared_endpoint: str
) -> None:
    told = crkr("new", "left_arm").stdout
    assert told.count("wrote ") == 3
    assert "crkr workers left_arm.py:make" in told
    names = ["left_arm.py", "left_arm.toml", "test_left_arm.py"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    text = "".join((tmp_path / name).read_text() for name in names)
    assert "robot" not in text.lower().replace("your robot", "")
    assert "LeftArm" in text
    found = json.loads(crkr("check-skill", "left_arm:make", "--json").stdout)
    assert {one["level"] for one in found} == {"ok"}
    own = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert own.returncode == 0, own.stdout
    assert "2 passed" in own.stdout
    at = ("--connect", shared_endpoint)
    crkr("workers", "left_arm.py:make", "--trials", "150", "--evaluations", "0", "--seed", "1", *at)
    with Client(shared_endpoint, timeout_s=30.0) as client:
        assert client.task("left-arm").spec.skill == f"{tmp_path}/left_arm.py:make"
    judged = json.loads(crkr("evaluate", "left-arm", "--contexts", "60", "--json", *at).stdout)
    assert judged["success"] >= 0.7
    assert "is there already" in crkr("new", "left_arm", status=1).stderr
    assert "Python module's" in crkr("new", "Left-Arm", status=1).stderr


def test_a_new_skill_hides_no_module_of_python(crkr: Crkr, tmp_path: Path) -> None:
    for name in ("class", "json", "numpy", "crkr"):
        assert "choose another" in crkr("new", name, status=1).stderr
    (tmp_path / "file").touch()
    assert "cannot be written" in crkr("new", "own_arm", "--in", "file/inside", status=1).stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_changed_specification_begins_anew_with_fresh(crkr: Crkr, tmp_path: Path, shared_endpoint: str) -> None:
    crkr("new", "fresh_arm", "--in", "here")
    run = ("workers", "here/fresh_arm.py:make", "--trials", "5", "--evaluations", "0", "--connect", shared_endpoint)
    crkr(*run)
    path = tmp_path / "here" / "fresh_arm.toml"
    path.write_text(path.read_text().replace("high = 9.0", "high = 8.0"))
    assert "--fresh" in crkr(*run, status=1).stderr
    assert "deleted the task fresh-arm" in crkr(*run, "--fresh").stderr
    with Client(shared_endpoint, timeout_s=30.0) as client:
        assert client.task("fresh-arm").spec.goal[0].high == 8.0
        assert sum(client.task("fresh-arm").status()["samples"].values()) == 5
        client.task("fresh-arm").delete()
        with pytest.raises(UnknownTask):
            client.task("fresh-arm").status()
    crkr(*run, "--fresh")


@pytest.mark.parametrize(
    ("change", "level", "says"),
    [
        ({}, "ok", "repeated trials are equal"),
        ({"state": "self.x, 1.0"}, "problem", "the state"),
        ({"state": "7 * self.x"}, "warning", "x leaves its box"),
        ({"state": "1.02 * self.x"}, "ok", "40 states"),
        ({"state": "0.3"}, "warning", "x is 0.3 in all states"),
        ({"execute": "raise RuntimeError('motor')"}, "problem", "RuntimeError: motor"),
        ({"execute": "return 3"}, "problem", "must return a TrialResult"),
        (
            {"execute": "return TrialResult(None, False, False, info={'reason': 'far'})"},
            "warning",
            "are refused: far 40",
        ),
        ({"cost": "3.2"}, "problem", "cost"),
        ({"cost": "0.5"}, "warning", "is 0.5 in all trials"),
        ({"cost": "1.0 if abs(goal[0] - self.x) > 0.1 else 0.1"}, "warning", "is 1 in"),
        ({"cost": "0.0 if abs(goal[0] - self.x) < 0.1 else 0.9"}, "warning", "is 0 at times"),
        ({"outcome": "abs(goal[0] - self.x)"}, "warning", "miss is never negative"),
        ({"outcome": "np.nan"}, "warning", "miss is never observed"),
        ({"outcome": "np.sin(3e4 * goal[0])"}, "warning", "miss jumps by"),
        ({"outcome": "goal[0] - self.x + np.random.normal()"}, "warning", "repeated trials differ by up to"),
        ({"outcome": "1.0, 2.0"}, "problem", "outcome"),
        ({"scene": "3"}, "problem", "cannot be drawn"),
        ({"scene": "[Geom('b', 'sphere', (0.1, 0.0, 0.0))]"}, "warning", "has no poses for b"),
        ({"trace": "None"}, "warning", "displays show no motion"),
        ({"trace": "Trace(np.zeros(1), ('a',), np.zeros((2, 1, 3)), np.zeros((1, 1, 4)))"}, "problem", "positions"),
    ],
)
def test_a_check_says_what_is_wrong(tmp_path: Path, change: dict[str, str], level: str, says: str) -> None:
    name = f"faulty_{abs(hash(str(change)))}"
    (tmp_path / f"{name}.py").write_text(FAULTY.format(**{**FINE, **change}))
    skill = load_skill(f"{tmp_path}/{name}.py:make", SkillOptions())
    found = [(one.level, one.message) for one in check(skill)]
    assert [message for its, message in found if its == level and says in message], found
    assert bool(problems(skill)) == (level == "problem")


def test_a_problem_is_the_commands_status(crkr: Crkr, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(FAULTY.format(**{**FINE, "execute": "raise RuntimeError('motor')"}))
    done = crkr("check-skill", "broken:make", status=1)
    assert "problem  execute: RuntimeError: motor" in done.stdout
    assert done.stderr.count("\n") <= 3


def test_a_trial_that_does_not_end_is_a_problem_and_its_line_is_named(crkr: Crkr, tmp_path: Path) -> None:
    waits = "import threading; print('waits'); threading.Event().wait()"
    (tmp_path / "endless.py").write_text(FAULTY.format(**{**FINE, "execute": waits}))
    line = (tmp_path / "endless.py").read_text().splitlines().index(f"        {waits}") + 1
    done = crkr("check-skill", "endless:make", "--timeout", "0.2", "--json", status=1)
    assert json.loads(done.stdout)[-1] == {
        "level": "problem",
        "what": "execute",
        "message": f"a trial did not end within 0.2 s; it is at endless.py, line {line}; --timeout allows more",
    }
    assert done.stderr == "waits\n"


def test_of_what_a_task_remembers_only_code_of_ones_own_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert portable_name("mine.py:make") == f"{tmp_path}/mine.py:make"
    assert portable_name("table-tennis") == "table-tennis"
    spec = TaskSpec.from_dict(
        {"name": "task", **{part: [{"name": "x", "low": 0, "high": 1}] for part in ("state", "goal")}}
    )

    def remembered(name: str) -> str | None:
        return skill_of(replace(spec, skill=name))

    assert remembered("") is None
    assert skill_of(replace(spec, name="table-tennis")) == "table-tennis"
    for name in ("mine:make", f"{tmp_path}/mine.py:make", "table-tennis", "gymnasium:Reacher-v5"):
        assert remembered(name) == name
    for name in ("os:abort", "elsewhere:make", "gymnasium:this:Reacher-v5"):  # which Gymnasium would import
        with pytest.raises(Invalid, match="by --skill"):
            remembered(name)
    with pytest.raises(Invalid, match="there is no file"):
        remembered(f"{tmp_path}/gone.py:make")


def test_the_page_about_skills_runs_as_it_is_printed(crkr: Crkr, shared_endpoint: str) -> None:
    page = (Path(__file__).parents[3] / "docs" / "skills.md").read_text()
    [block] = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    lines = [shlex.split(line, comments=True) for line in block.splitlines()]
    assert [words[1] for words in lines] == ["new", "check-skill", "server", "workers", "evaluate", "watch"]
    for _, command, *words in lines:
        if command in ("server", "watch"):  # one runs already, the other until it is ended
            continue
        crkr(command, *words, *(() if command in ("new", "check-skill") else ("--connect", shared_endpoint)))
