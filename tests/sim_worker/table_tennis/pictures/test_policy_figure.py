"""The policy's figure, from a live task to a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.client import Client
from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.pictures.policy_figure import varied
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis import TableTennis


def test_one_coordinate_goes_through_its_box_while_the_others_rest(skill: TableTennis) -> None:
    spec = skill.spec()
    index, states = varied(spec, "ball_vy", 5)
    assert index == 4
    assert states[[0, -1], 4].tolist() == [spec.state[4].low, spec.state[4].high]
    others = np.delete(states, 4, axis=1)
    assert (others == others[0]).all()
    assert others[0].tolist() == pytest.approx([0.5, 0.0, 1.185, -4.44, -0.444])
    assert varied(spec, "ball_y", 3, [1, 2, 3, 4, 5, 6])[1][:, 5].tolist() == [6, 6, 6]


def test_what_cannot_be_drawn_is_refused(skill: TableTennis) -> None:
    with pytest.raises(Invalid, match="there are ball_x"):
        varied(skill.spec(), "spin", 5)
    with pytest.raises(Invalid, match="6 numbers"):
        varied(skill.spec(), "ball_y", 5, [0.0])


def test_the_command_draws_a_live_tasks_policy(
    client: Client, shared_endpoint: str, start_command: Callable[..., Any], tmp_path: Path
) -> None:
    skill = TableTennis(SkillOptions(environment="analytic", name="drawn"), traces=False)
    task = client.create_task(skill.spec())
    for shown in skill.demonstrations(3, np.random.default_rng(0)):
        task.report(state=shown.state, goal=shown.goal, cost=0.0, success=True, kind="demonstration")
    picture = tmp_path / "policy.png"
    words = ("plot", "policy", "drawn", "--vary", "ball_y", "--out", str(picture), "--connect", shared_endpoint)
    status, _, log = start_command(*words).finish()
    assert status == 0, log
    drawn = imread(picture)[..., :3]
    assert drawn.shape[0] > 400
    assert drawn.std() > 0.05
    before = picture.read_bytes()
    status, _, log = start_command(*words).finish()
    assert (status, log) == (1, f"error: {picture} exists; choose another file, or --overwrite\n")
    assert picture.read_bytes() == before
    status, _, log = start_command(*words[:4], "spin", *words[5:], "--overwrite").finish()
    assert status != 0
    assert "there are ball_x" in log


def test_a_task_whose_skill_draws_nothing_gets_curves_of_its_goals(
    client: Client, shared_endpoint: str, start_command: Callable[..., Any], tmp_path: Path
) -> None:
    axes = [{"name": name, "low": 0, "high": 1, "scale": 0.2} for name in "abcde"]
    spec = {"name": "plain", "state": [{"name": "a", "low": 0, "high": 1}], "goal": axes}
    task = client.create_task(TaskSpec.from_dict(spec))
    for state in (0.2, 0.6):
        task.report(state=[state], goal=[state] * 5, cost=0.1, success=True)
    words = ("plot", "policy", "plain", "--connect", shared_endpoint)  # the first coordinate varies
    status, _, log = start_command(*words, "--out", str(tmp_path / "a.png")).finish()
    assert status == 0, log
    assert imread(tmp_path / "a.png")[..., :3].std() > 0.05
    status, _, log = start_command(*words, "--skill", "throw", "--out", str(tmp_path / "b.png")).finish()
    assert (status, "has other states or goals than the skill" in log) == (1, True), log
