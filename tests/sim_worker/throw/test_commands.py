"""Commands on a task of throws, which is told by its specification which skill it is for."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.client import Client, Task
from crkr.sim_worker.skill_registry import specification
from crkr.sim_worker.throw import Throw

Start = Callable[..., Any]


@pytest.fixture
def lobs(client: Client, analytic: Throw) -> Task:
    """A task of another name than its skill, with a few demonstrations."""
    task = client.create_task(specification("throw", name="lobs"))
    for shown in analytic.demonstrations(3, np.random.default_rng(0)):
        task.report(
            state=shown.state, goal=shown.goal, cost=0.0, success=True, kind="demonstration",
            outcome=shown.result.outcome,
        )  # fmt: skip
    return task


def test_a_policy_is_judged_and_drawn_without_being_told_its_skill(
    lobs: Task, shared_endpoint: str, start_command: Start, tmp_path: Path
) -> None:
    assert lobs.spec.skill == "throw"
    there = ("--connect", shared_endpoint)
    words = ("evaluate", lobs.name, "--contexts", "4", "--environment", "analytic", "--json", *there)
    result = start_command(*words).result()
    assert (sum(result["reasons"].values()), result["oracle"]["success"]) == (4, 1.0)
    figure = tmp_path / "policy.png"
    status, _, log = start_command(
        "plot", "policy", lobs.name, "--vary", "bin_y", "--out", str(figure), *there
    ).finish()
    assert status == 0, log
    assert imread(figure)[..., :3].std() > 0.05
    drawn = tmp_path / "throw.gif"
    render = ("render", "--task", lobs.name, "--environment", "analytic", str(drawn))
    status, _, log = start_command(*render, *there).finish()
    assert status == 0, log
    assert drawn.stat().st_size > 10_000
