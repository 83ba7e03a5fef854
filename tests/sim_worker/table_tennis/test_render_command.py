"""`crkr render` on a real server's log, and without what it needs."""

import subprocess
import sys
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.client import Client, Task
from crkr.protocol import TaskSpec
from crkr.sim_worker.skill import SkillOptions, TrialResult
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture
def hybrid() -> TableTennis:
    return TableTennis(SkillOptions(environment="hybrid", name="replayed"), traces=False)


@pytest.fixture
def replayed(client: Client, hybrid: TableTennis) -> Task:
    return client.create_task(hybrid.spec())


def _store(task: Task, skill: TableTennis, bend: float, joint: int = 0) -> tuple[UUID, TrialResult]:
    """A trial as a worker stores it, of a planned goal with one joint `bend` away [rad]."""
    state = skill.reset(np.random.default_rng(5))
    plan = skill.plan(state)
    assert plan is not None
    goal = plan[0] + bend * np.eye(13)[joint]
    result, name = skill.execute(goal), uuid4()
    task.report(
        state=state,
        goal=goal,
        cost=result.cost,
        success=result.success,
        kind="trial" if result.executed else "failed",
        outcome=result.outcome,
        info=result.info,
        id=name,
    )
    return name, result


def test_a_stored_trial_is_played_again_to_the_bit(
    replayed: Task, hybrid: TableTennis, shared_endpoint: str, start_command: Any, tmp_path: Path
) -> None:
    name, result = _store(replayed, hybrid, 0.02)
    words = ("render", "--trial", str(name), "--task", "replayed", "--connect", shared_endpoint)
    status, output, log = start_command(*words, "--environment", "hybrid", str(tmp_path / "a.png")).finish()
    told = " ".join(log.split())
    assert (status, output) == (0, ""), log
    assert f"trial {name}, played again from the stored state and goal in hybrid: {result.info['reason']}" in told
    assert "to the bit what was measured then" in told
    assert imread(tmp_path / "a.png").shape[:2] == (720, 1280)
    status, _, log = start_command(*words, "--environment", "contact", str(tmp_path / "b.png")).finish()
    told = " ".join(log.split())
    assert status == 0, log
    assert f"the log says {result.info['reason']}, cost {result.cost:.4f}: environment or skill differ" in told


def test_a_trial_in_which_nothing_moved_has_no_picture(
    replayed: Task, hybrid: TableTennis, shared_endpoint: str, start_command: Any, tmp_path: Path
) -> None:
    name, result = _store(replayed, hybrid, 0.5, joint=1)
    assert not result.executed
    words = ("render", "--trial", str(name), "--task", "replayed", "--connect", shared_endpoint)
    status, _, log = start_command(*words, str(tmp_path / "a.png")).finish()
    assert status == 1
    assert f"nothing moved: the goal is refused ({result.info['reason']})" in " ".join(log.split())
    assert not (tmp_path / "a.png").exists()


def test_what_the_log_does_not_have_is_said(
    replayed: Task, client: Client, shared_endpoint: str, start_command: Any, tmp_path: Path
) -> None:
    absent = str(uuid4())
    words = ("render", "--trial", absent, "--connect", shared_endpoint, str(tmp_path / "a.png"), "--task")
    status, _, log = start_command(*words, "replayed").finish()
    assert (status, "has no trial" in log) == (1, True), log
    other = {
        "name": "throwing",
        "state": [{"name": "x", "low": 0, "high": 1}],
        "goal": [{"name": "v", "low": 0, "high": 1}],
    }
    client.create_task(TaskSpec.from_dict(other))
    status, _, log = start_command(*words, "throwing").finish()
    assert (status, "states of 6 and goals of 13" in log) == (1, True), log


@pytest.mark.parametrize("extra", [("--seed", "3"), ("--context", "1"), ("--launcher", "wide")])
def test_a_stored_trial_has_its_own_context(start_command: Any, tmp_path: Path, extra: tuple[str, str]) -> None:
    status, _, log = start_command("render", "--trial", str(uuid4()), *extra, str(tmp_path / "a.png")).finish()
    assert (status, "own context" in log) == (2, True), log


def test_a_picture_cannot_be_slow(start_command: Any, tmp_path: Path) -> None:
    status, _, log = start_command("render", "--slow", "4", str(tmp_path / "a.png")).finish()
    assert (status, len(log.splitlines()), "can be slow" in log) == (1, 1, True), log
    assert not (tmp_path / "a.png").exists()


def test_a_picture_that_is_there_is_replaced_only_where_that_was_asked_for(start_command: Any, tmp_path: Path) -> None:
    picture = tmp_path / "a.png"
    picture.write_text("of an earlier run")
    words = ("render", "--environment", "analytic", str(picture))
    status, _, log = start_command(*words).finish()
    assert (status, log) == (1, f"error: {picture} exists; choose another file, or --overwrite\n")
    assert picture.read_text() == "of an earlier run"
    assert start_command(*words, "--overwrite").finish()[0] == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["throw", "table-tennis"])
def test_the_plan_of_a_shipped_skill_is_drawn(start_command: Any, tmp_path: Path, name: str) -> None:
    words = ("render", "--skill", name, "--environment", "analytic", "--context", "2", str(tmp_path / "a.png"))
    status, _, log = start_command(*words).finish()
    assert (status, "context 2 of seed 0, " in " ".join(log.split())) == (0, True), log
    assert imread(tmp_path / "a.png").shape[:2] == (720, 1280)


def _reaching(client: Client, name: str) -> str:
    """Name of a task of R^2 to R^2 with one trial."""
    axes = [{"name": axis, "low": -1, "high": 1} for axis in "xy"]
    goals = [axis | {"scale": 0.2} for axis in axes]
    task = client.create_task(TaskSpec.from_dict({"name": name, "state": axes, "goal": goals}))
    task.report(state=[0.1, 0.2], goal=[0.1, 0.2], cost=0.1, success=True)
    return name


def test_a_skill_that_tells_no_plan_is_drawn_for_a_task_only(
    client: Client, shared_endpoint: str, start_command: Any, tmp_path: Path
) -> None:
    words = ("render", "--skill", "reaching:make", str(tmp_path / "a.png"))
    status, _, log = start_command(*words).finish()
    told = " ".join(log.split())
    assert (status, "tells no plan of its own (a method `plan`); name a task" in told) == (1, True), log
    of_task = ("--task", _reaching(client, "drawn-points"), "--connect", shared_endpoint)
    assert start_command(*words, *of_task).finish()[0] == 0
    assert imread(tmp_path / "a.png").shape[:2] == (720, 1280)
    status, _, log = start_command(*words, *of_task, "--overwrite", "--trial", str(uuid4())).finish()
    assert (status, "cannot put a stored state (a method `restore`)" in " ".join(log.split())) == (1, True), log


def test_a_skill_without_shapes_cannot_be_drawn(
    client: Client, shared_endpoint: str, start_command: Any, tmp_path: Path
) -> None:
    name = _reaching(client, "drawn-bare")
    words = ("render", "--skill", "reaching:make_bare", "--task", name, "--connect", shared_endpoint)
    status, _, log = start_command(*words, str(tmp_path / "a.png")).finish()
    assert (status, "Bare has no shapes (a method `scene`)" in log) == (1, True), log


def test_without_the_library_for_films_one_line_says_what_to_install(tmp_path: Path) -> None:
    """In a process where PyAV cannot be found."""
    program = (
        "import sys\n"
        "class Absent:\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name.split('.')[0] == 'av':\n"
        "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "sys.argv = ['crkr', 'render', 'trial.mp4']\n"
        "from crkr.client.cli.main import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "error: crkr render needs the extra 'film': pip install 'crkr[film]'\n"
    assert list(tmp_path.iterdir()) == []
