"""Software rendering works, and shows what moved."""

from pathlib import Path

import av
import numpy as np
import pytest
from matplotlib.image import imread

from crkr.protocol import Invalid
from crkr.sim_worker.pictures.renderer import SceneRenderer, save_picture
from crkr.sim_worker.pictures.trial_picture import check_kind, planned, render_trial
from crkr.sim_worker.simulation.simulation import Simulation
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.pictures.trace import Motion
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture(scope="module")
def motion(skill: TableTennis) -> Motion:
    ball = skill.reset(np.random.default_rng(5))
    plan = skill.plan(ball)
    assert plan is not None
    filmed = skill.film(ball, plan[0], 0.2)
    assert filmed is not None
    return filmed


def test_frames_differ_where_arm_and_ball_moved(simulation: Simulation, motion: Motion) -> None:
    with SceneRenderer(simulation, 320, 180) as artist:
        first, again, last = (artist.frame(motion, row) for row in (0, 0, -1))
    assert first.shape == (180, 320, 3)
    assert (first == again).all()
    changed = (np.abs(first.astype(int) - last).max(axis=2) > 20).mean()
    assert 0.001 < changed < 0.3
    assert first.std() > 20  # not one colour


def test_a_picture_shows_ball_and_paddle_in_their_colours(
    simulation: Simulation, motion: Motion, tmp_path: Path
) -> None:
    with SceneRenderer(simulation, 640, 360) as artist:
        save_picture(artist, motion, tmp_path / "trial.png")
        with pytest.raises(Invalid, match=r"\.png"):
            save_picture(artist, motion, tmp_path / "trial.jpg")
    red, green, blue = np.moveaxis(imread(tmp_path / "trial.png")[..., :3], 2, 0)
    assert red.shape == (360, 640)
    # The brown floor has blue within 0.15 of its red.
    assert ((red > 0.6) & (red - blue > 0.35) & (green - blue > 0.1)).sum() > 10  # the ball's orange
    assert ((red > 0.3) & (red - blue > 0.2) & (np.abs(green - blue) < 0.05)).sum() > 10  # the blade's red


def test_an_exposure_shows_what_moves_at_every_moment_and_the_arm_solid_at_one(
    simulation: Simulation, motion: Motion
) -> None:
    last = len(motion.time) - 1
    with SceneRenderer(simulation, 320, 180) as artist:
        still, first = artist.exposure(motion, [last], last), artist.exposure(motion, [0, last], last)
        other = artist.exposure(motion, [0, last], 0)
        alone = artist.frame(motion, last)
    assert (still == alone).all()
    added = np.abs(first.astype(int) - still).max(axis=2) > 10
    assert 0.002 < added.mean() < 0.2
    assert (first != other).any()


def test_the_balls_path_changes_colour_at_the_hit_time(simulation: Simulation, skill: TableTennis) -> None:
    moved = skill.film(*planned(skill, 3, 0), 0.01)
    assert moved is not None
    hit = int(np.searchsorted(moved.time, moved.hit_time))
    pale, strong = [], []
    with SceneRenderer(simulation, 320, 180) as artist:
        for row in (hit - 1, len(moved.time) - 1):
            red, green, blue = np.moveaxis(artist.frame(moved, row) / 255, 2, 0)
            pale.append(((red > 0.6) & (green > 0.55) & (red - blue > 0.1)).sum())
            strong.append(((red > 0.5) & (red - green > 0.2) & (green - blue > 0.1)).sum())
    assert pale[0] > 20
    assert strong[1] > strong[0] + 20


def test_a_sequence_shows_six_moments_each_with_a_caption(
    skill: TableTennis, simulation: Simulation, tmp_path: Path
) -> None:
    state, goal = planned(skill, 3, 0)
    render_trial(skill, state, goal, tmp_path / "swing.png", width=320, height=180, sequence=True)
    picture = imread(tmp_path / "swing.png")[..., :3]
    assert picture.shape[:2] == (360, 960)
    panels = [picture[180 * r : 180 * r + 180, 320 * c : 320 * c + 320] for r in (0, 1) for c in range(3)]
    assert all(np.abs(a - b)[30:].max() > 0.1 for i, a in enumerate(panels) for b in panels[:i])
    assert all(((panel[:24, :160] < 0.3).all(axis=2)).sum() > 20 for panel in panels)
    moved = skill.film(state, goal, 0.01)
    assert moved is not None
    assert moved.hit_time == goal[12]
    with SceneRenderer(simulation, 320, 180) as artist:
        for panel, time in ((panels[0], 0.0), (panels[3], goal[12]), (panels[5], moved.time[-1])):
            frame = artist.frame(moved, int(np.abs(moved.time - time).argmin())) / 255
            assert np.abs(panel - frame)[30:].max() < 0.01


@pytest.mark.parametrize(
    ("name", "sequence", "slow", "complaint"),
    [
        ("trial.jpg", False, 1.0, r"\.mp4"),
        ("trial", False, 1.0, r"\.png"),
        ("trial.gif", True, 1.0, r"\.png"),
        ("trial.png", False, 4.0, r"\.mp4 or a \.gif, can be slow"),
        ("trial.png", True, 4.0, r"\.mp4 or a \.gif, can be slow"),
        ("no/trial.png", False, 1.0, "no folder"),
    ],
)
def test_what_cannot_be_saved_is_refused_before_anything_is_drawn(
    tmp_path: Path, name: str, sequence: bool, slow: float, complaint: str
) -> None:
    with pytest.raises(Invalid, match=complaint):
        check_kind(tmp_path / name, sequence=sequence, slow=slow)


def test_a_refused_goal_has_no_film(skill: TableTennis, tmp_path: Path) -> None:
    ball = skill.reset(np.random.default_rng(5))
    assert skill.film(ball, np.full(13, np.nan), 0.1) is None
    with pytest.raises(Invalid, match=r"nothing moved.*invalid"):
        render_trial(skill, ball, np.full(13, np.nan), tmp_path / "none.png")
    assert not list(tmp_path.iterdir())


def test_the_planners_trial_can_be_drawn_by_seed(tmp_path: Path) -> None:
    skill = TableTennis(SkillOptions(launcher="medium"))
    state, goal = planned(skill, 3, 0)
    assert render_trial(skill, state, goal, tmp_path / "trial.png", width=160, height=90).info["reason"] == "returned"
    assert imread(tmp_path / "trial.png").shape[:2] == (90, 160)


@pytest.mark.parametrize("slow", [1.0, 2.0])
def test_a_film_lasts_as_long_as_the_trial_or_that_many_times_longer(
    skill: TableTennis, tmp_path: Path, slow: float
) -> None:
    state, goal = planned(skill, 3, 0)
    moved = skill.film(state, goal, 0.01)
    assert moved is not None
    render_trial(skill, state, goal, tmp_path / "trial.mp4", width=64, height=36, slow=slow)
    with av.open(str(tmp_path / "trial.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.duration is not None
        assert stream.time_base is not None
        lasts = float(stream.duration * stream.time_base)
    assert lasts == pytest.approx(slow * moved.time[-1], abs=0.15)
