"""What MUJOCO_GL and its like say matters to what draws, and to nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

PLAYS = """
import numpy as np
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis import make
skill = make(SkillOptions())
(shown,) = skill.demonstrations(1, np.random.default_rng(0))
print("played" if shown.result.executed else "refused")
"""


def run(environment: dict[str, str], *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *command], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("name", ["cgl", "osmesa", "egl", "glfw", "off", "rubbish", ""])
def test_trials_are_played_whatever_is_said_of_opengl(name: str) -> None:
    done = run({"MUJOCO_GL": name, "PYOPENGL_PLATFORM": "rubbish"}, "-c", PLAYS)
    assert (done.returncode, done.stdout) == (0, "played\n"), done.stderr


@pytest.mark.parametrize("name", ["cgl", "off", "rubbish"])
def test_what_cannot_draw_says_so_in_one_line_that_names_the_variable(tmp_path: Path, name: str) -> None:
    words = ("render", str(tmp_path / "a.png"), "--environment", "analytic")
    done = run({"MUJOCO_GL": name}, "-m", "crkr.client", *words)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert f"MUJOCO_GL={name}" in line
    assert not list(tmp_path.iterdir())


def test_a_display_that_is_gone_leaves_drawing_without_one(tmp_path: Path) -> None:
    words = ("render", str(tmp_path / "a.png"), "--environment", "analytic")
    headless = run({"DISPLAY": ""}, "-m", "crkr.client", *words)
    stale = run({"DISPLAY": ":77", "PYOPENGL_PLATFORM": "osmesa"}, "-m", "crkr.client", *words, "--overwrite")
    assert stale.returncode == headless.returncode, stale.stderr
    assert len(stale.stderr.splitlines()) == 1
