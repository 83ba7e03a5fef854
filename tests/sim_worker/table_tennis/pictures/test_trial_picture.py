"""Software rendering works, and shows what moved."""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest
from matplotlib.image import imread

from crkr.protocol import Geom, Invalid
from crkr.sim_worker.pictures.renderer import SceneRenderer
from crkr.sim_worker.pictures.trial_picture import check_kind, render_trial
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import Film, SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


@pytest.fixture(scope="module")
def shapes(skill: TableTennis) -> Sequence[Geom]:
    return skill.scene()


@pytest.fixture
def goal(skill: TableTennis) -> np.ndarray:
    """A planned goal for the ball that the skill holds ready."""
    plan = skill.plan(skill.reset(fresh_rng(3, 0)))
    assert plan is not None
    return plan[0]


def _film(skill: TableTennis, goal: np.ndarray, interval: float) -> Film:
    filmed = skill.film(goal, interval)
    assert filmed is not None
    return filmed


def test_frames_differ_where_arm_and_ball_moved(skill: TableTennis, shapes: Sequence[Geom], goal: np.ndarray) -> None:
    with SceneRenderer(shapes, _film(skill, goal, 0.2), 320, 180) as artist:
        first, again, last = (artist.frame(row) for row in (0, 0, -1))
    assert first.shape == (180, 320, 3)
    assert (first == again).all()
    changed = (np.abs(first.astype(int) - last).max(axis=2) > 20).mean()
    assert 0.001 < changed < 0.3
    assert first.std() > 20  # not one colour


def test_a_picture_shows_ball_and_paddle_in_their_colours(skill: TableTennis, goal: np.ndarray, tmp_path: Path) -> None:
    render_trial(skill, goal, tmp_path / "trial.png", width=640, height=360)
    red, green, blue = np.moveaxis(imread(tmp_path / "trial.png")[..., :3], 2, 0)
    assert red.shape == (360, 640)
    # The brown floor has blue within 0.15 of its red.
    assert ((red > 0.6) & (red - blue > 0.35) & (green - blue > 0.1)).sum() > 10  # the ball's orange
    assert ((red > 0.3) & (red - blue > 0.2) & (np.abs(green - blue) < 0.05)).sum() > 10  # the blade's red


def test_an_exposure_shows_what_moves_at_every_moment_and_the_arm_solid_at_one(
    skill: TableTennis, shapes: Sequence[Geom], goal: np.ndarray
) -> None:
    film = _film(skill, goal, 0.2)
    last = len(film.trace.time) - 1
    with SceneRenderer(shapes, film, 320, 180) as artist:
        still, first = artist.exposure([last], last), artist.exposure([0, last], last)
        other = artist.exposure([0, last], 0)
        alone = artist.frame(last)
    assert (still == alone).all()
    added = np.abs(first.astype(int) - still).max(axis=2) > 10
    assert 0.002 < added.mean() < 0.2
    assert (first != other).any()


def test_the_balls_path_changes_colour_at_the_hit_time(
    skill: TableTennis, shapes: Sequence[Geom], goal: np.ndarray
) -> None:
    film = _film(skill, goal, 0.01)
    assert film.moment == goal[12]
    hit = int(np.searchsorted(film.trace.time, goal[12]))
    pale, strong = [], []
    with SceneRenderer(shapes, film, 320, 180) as artist:
        for row in (hit - 1, len(film.trace.time) - 1):
            red, green, blue = np.moveaxis(artist.frame(row) / 255, 2, 0)
            pale.append(((red > 0.6) & (green > 0.55) & (red - blue > 0.1)).sum())
            strong.append(((red > 0.5) & (red - green > 0.2) & (green - blue > 0.1)).sum())
    assert pale[0] > 20
    assert strong[1] > strong[0] + 20


def test_a_sequence_shows_six_moments_each_with_a_caption(
    skill: TableTennis, shapes: Sequence[Geom], goal: np.ndarray, tmp_path: Path
) -> None:
    render_trial(skill, goal, tmp_path / "swing.png", width=320, height=180, sequence=True)
    picture = imread(tmp_path / "swing.png")[..., :3]
    assert picture.shape[:2] == (360, 960)
    panels = [picture[180 * r : 180 * r + 180, 320 * c : 320 * c + 320] for r in (0, 1) for c in range(3)]
    assert all(np.abs(a - b)[30:].max() > 0.1 for i, a in enumerate(panels) for b in panels[:i])
    assert all(((panel[:24, :160] < 0.3).all(axis=2)).sum() > 20 for panel in panels)
    film = _film(skill, goal, 0.01)
    times = film.trace.time
    with SceneRenderer(shapes, film, 320, 180) as artist:
        for panel, time in ((panels[0], 0.0), (panels[3], goal[12]), (panels[5], times[-1])):
            frame = artist.frame(int(np.abs(times - time).argmin())) / 255
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
    skill.reset(np.random.default_rng(5))
    assert skill.film(np.full(13, np.nan), 0.1) is None
    with pytest.raises(Invalid, match=r"nothing moved.*invalid"):
        render_trial(skill, np.full(13, np.nan), tmp_path / "none.png")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("slow", [1.0, 2.0])
def test_a_film_lasts_as_long_as_the_trial_or_that_many_times_longer(
    skill: TableTennis, goal: np.ndarray, tmp_path: Path, slow: float
) -> None:
    result = render_trial(skill, goal, tmp_path / "trial.mp4", width=64, height=36, slow=slow)
    assert result.info["reason"] == "returned"
    with av.open(str(tmp_path / "trial.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.duration is not None
        assert stream.time_base is not None
        lasts = float(stream.duration * stream.time_base)
    assert lasts == pytest.approx(slow * _film(skill, goal, 0.01).trace.time[-1], abs=0.15)


class Unfilmed:
    """Table tennis without what is optional but its scene and its traces."""

    def __init__(self) -> None:
        whole = TableTennis(SkillOptions(environment="analytic"))
        self.spec, self.reset, self.execute, self.scene = whole.spec, whole.reset, whole.execute, whole.scene


def test_a_skill_with_shapes_and_traces_alone_is_drawn_too(goal: np.ndarray, tmp_path: Path) -> None:
    skill = Unfilmed()
    skill.reset(fresh_rng(3, 0))
    assert render_trial(skill, goal, tmp_path / "trial.png", width=160, height=90).executed
    assert imread(tmp_path / "trial.png").std() > 0.05


def test_a_skill_without_traces_has_nothing_to_draw(goal: np.ndarray, tmp_path: Path) -> None:
    skill, traceless = Unfilmed(), TableTennis(SkillOptions(environment="analytic"), traces=False)
    traceless.reset(fresh_rng(3, 0))
    skill.execute = traceless.execute
    with pytest.raises(Invalid, match=r"Unfilmed have no motion \(`TrialResult.trace`\)"):
        render_trial(skill, goal, tmp_path / "none.png")
