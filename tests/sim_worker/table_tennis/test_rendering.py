"""Software rendering works, and shows what moved."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from crkr.protocol import Invalid
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.render_trial import render_trial
from crkr.sim_worker.table_tennis.rendering import Artist, save_film, save_picture
from crkr.sim_worker.table_tennis.simulation import Simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis
from crkr.sim_worker.table_tennis.tracing import Motion


@pytest.fixture(scope="module")
def motion(skill: TableTennis) -> Motion:
    ball = skill.reset(np.random.default_rng(5))
    plan = skill.plan(ball)
    assert plan is not None
    filmed = skill.film(ball, plan[0], 0.2)
    assert filmed is not None
    return filmed


def test_frames_differ_where_arm_and_ball_moved(simulation: Simulation, motion: Motion) -> None:
    with Artist(simulation, 320, 180) as artist:
        first, again, last = (artist.frame(motion, row) for row in (0, 0, -1))
    assert first.shape == (180, 320, 3)
    assert (first == again).all()
    changed = (np.abs(first.astype(int) - last).max(axis=2) > 20).mean()
    assert 0.001 < changed < 0.3
    assert first.std() > 20  # not one colour


def test_a_picture_and_a_film_can_be_saved(simulation: Simulation, motion: Motion, tmp_path: Path) -> None:
    with Artist(simulation, 160, 90) as artist:
        save_picture(artist, motion, tmp_path / "trial.png")
        save_film(artist, motion, tmp_path / "trial.gif", rate=5)
    assert imread(tmp_path / "trial.png").shape[:2] == (90, 160)
    assert (tmp_path / "trial.gif").read_bytes().startswith(b"GIF89a")


def test_a_sequence_shows_six_moments(tmp_path: Path) -> None:
    render_trial(SkillOptions(), 3, tmp_path / "swing.png", width=160, height=90, sequence=True)
    picture = imread(tmp_path / "swing.png")[..., :3]
    assert picture.shape[:2] == (180, 480)
    moments = [
        picture[90 * row : 90 * row + 90, 160 * column : 160 * column + 160] for row in (0, 1) for column in range(3)
    ]
    assert all(np.abs(a - b).max() > 0.1 for i, a in enumerate(moments) for b in moments[:i])
    with pytest.raises(Invalid, match=r"\.png"):
        render_trial(SkillOptions(), 3, tmp_path / "swing.gif", width=160, height=90, sequence=True)


def test_other_kinds_of_file_are_refused(simulation: Simulation, motion: Motion, tmp_path: Path) -> None:
    with Artist(simulation, 64, 64) as artist:
        with pytest.raises(Invalid, match=r"\.png"):
            save_picture(artist, motion, tmp_path / "trial.jpg")
        with pytest.raises(Invalid, match=r"\.mp4"):
            save_film(artist, motion, tmp_path / "trial.avi")


def test_a_refused_goal_has_no_film(skill: TableTennis) -> None:
    ball = skill.reset(np.random.default_rng(5))
    assert skill.film(ball, np.full(13, np.nan), 0.1) is None


def test_the_planners_trial_can_be_drawn_by_seed(tmp_path: Path) -> None:
    assert render_trial(SkillOptions(launcher="medium"), 3, tmp_path / "trial.png", width=160, height=90) == "returned"
    assert imread(tmp_path / "trial.png").shape[:2] == (90, 160)
    with pytest.raises(Invalid, match="refused"):
        render_trial(SkillOptions(), 3, tmp_path / "none.png", goal=np.zeros(13))
