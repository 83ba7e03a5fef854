"""The policy's figure, from a live task to a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.client import Client
from crkr.protocol import Invalid, TaskSpec
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis import TableTennis
from crkr.sim_worker.table_tennis.pictures.policy_figure import varied


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
    axis = {"name": "a", "low": 0, "high": 1}
    other = TaskSpec.from_dict({"name": "other", "state": [axis], "goal": [axis | {"scale": 1}]})
    with pytest.raises(Invalid, match="table tennis"):
        varied(other, "a", 5)


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
