"""Figures of any task's trials, from a live task to a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.client import Client
from crkr.protocol import Invalid, StoredTrial, TaskSpec, Trial
from crkr.sim_worker.pictures.run_figures import Run, draw_coverage, draw_learning

SPEC = {
    "name": "plotted",
    "state": [{"name": "x", "unit": "m", "low": 0, "high": 1}, {"name": "still", "low": 0, "high": 1}],
    "goal": [{"name": "g", "low": 0, "high": 1}],
}


def run(count: int, kind: str = "trial") -> Run:
    spec = TaskSpec.from_dict(SPEC)
    rng = np.random.default_rng(0)

    def stored(seq: int) -> StoredTrial:
        point = {"state": [rng.uniform(), 0.5], "goal": [0.5]}
        values: dict[str, Any] = {**point, "cost": rng.uniform(), "success": bool(seq % 3)}
        return StoredTrial(Trial.create(spec, id=UUID(int=seq), kind=kind, **values), seq, 1000.0 + seq)

    return Run(spec, map(stored, range(1, count + 1)))


@pytest.mark.parametrize("count", [1, 49, 50, 51, 2500])
def test_runs_of_any_length_are_drawn(count: int, tmp_path: Path) -> None:
    made = run(count)
    draw_learning(made, tmp_path / "learning.png")
    draw_coverage(made, np.array([[0.5, 0.5]]), tmp_path / "coverage.png")
    for name in ("learning.png", "coverage.png"):
        assert imread(tmp_path / name)[..., :3].std() > 0.02


def test_a_run_without_training_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="has no training trial yet"):
        draw_learning(run(3, "evaluation"), tmp_path / "x.png")
    with pytest.raises(Invalid, match="has no training trial yet"):
        draw_coverage(run(0), np.zeros((0, 2)), tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


def test_the_commands_draw_a_live_task(
    client: Client, shared_endpoint: str, start_command: Callable[..., Any], tmp_path: Path
) -> None:
    task = client.create_task(TaskSpec.from_dict(SPEC))
    for state in (0.2, 0.4, 0.6):
        task.report(state=[state, 0.5], goal=[state], cost=0.1, success=True, wait=True)
    for name, told in (
        ("learning", "3 training trials, 0 evaluations"),
        ("coverage", "3 training trials, 3 active samples"),
    ):
        picture = tmp_path / f"{name}.svg"
        words = ("plot", name, "plotted", "--out", str(picture), "--connect", shared_endpoint)
        status, _, log = start_command(*words).finish()
        assert (status, log.splitlines()[-1]) == (0, f"{picture}: {told}")
        assert "<svg" in picture.read_text()
        status, _, log = start_command(*words).finish()
        assert (status, log) == (1, f"error: {picture} exists; choose another file, or --overwrite\n")
