"""A picture or a film of one trial of any skill that offers shapes and motion."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from crkr.client.cli.output_file import output_file
from crkr.protocol import Array, Invalid, Trial
from crkr.sim_worker.pictures.film import FILMS, Picture, save_film
from crkr.sim_worker.pictures.renderer import SceneRenderer
from crkr.sim_worker.skill import Film, HasFilm, HasScene, Skill, TrialResult

__all__ = ["check_kind", "compared", "render_trial"]

PICTURE_INTERVAL: Final = 0.01  # between points of a path in a picture [s]
RATE: Final = 25  # frames a second: a GIF, which counts in hundredths of a second, can keep it


def check_kind(path: Path, *, sequence: bool = False, slow: float = 1.0) -> None:
    """Raises `Invalid`, before drawing, if nothing can be saved at `path`."""
    if sequence and path.suffix != ".png":
        raise Invalid(f"a sequence of moments is a .png; got {path.name}")
    if path.suffix not in (".png", *FILMS):
        raise Invalid(f"a picture is a .png, a film a .mp4 or a .gif; got {path.name}")
    if slow != 1.0 and path.suffix not in FILMS:
        raise Invalid(f"only a film, a .mp4 or a .gif, can be slow; {path.name} is a picture")
    if not path.absolute().parent.is_dir():
        raise Invalid(f"there is no folder {path.parent}; make it first")


def render_trial(
    skill: Skill,
    goal: Array,
    path: Path,
    *,
    width: int = 1280,
    height: int = 720,
    sequence: bool = False,
    slow: float = 1.0,
) -> TrialResult:
    """Executes a goal in the situation of the last `reset` or `restore`, draws it and saves the picture.

    Args:
        skill: Executes.
        goal: (p,) to try.
        path: A .png for one picture of several moments, a .mp4 or .gif for a film.
        width: [pixels].
        height: [pixels]; of each moment in a sequence.
        sequence: Show the moments of a .png one beside the other rather than in one picture.
        slow: How many times slower than life a film runs; 1 for a .png.

    Returns:
        The trial's result.

    Raises:
        Invalid: Another suffix, an option that does not fit it, no such folder, a refused goal, or a skill with nothing
            to draw.
        Unsupported: This machine cannot render.
        ModuleNotFoundError: PyAV is not installed, for an .mp4.
    """
    check_kind(path, sequence=sequence, slow=slow)
    if not isinstance(skill, HasScene):
        raise Invalid(f"nothing to draw: {type(skill).__name__} has no shapes (a method `scene`)")
    interval = PICTURE_INTERVAL if path.suffix == ".png" else 1 / (RATE * slow)
    result = skill.execute(goal)
    if not result.executed:
        reason = result.info.get("reason", "failed")
        raise Invalid(f"nothing to draw, as nothing moved: the goal is refused ({reason})")
    film = _film(skill, goal, result, interval)
    with SceneRenderer(skill.scene(), film, width, height) as artist:
        if path.suffix == ".png":
            _save_picture(_strip(artist, film) if sequence else _exposure(artist, film), path)
        else:
            save_film(artist.frames(), path, RATE)
    return result


def _film(skill: Skill, goal: Array, result: TrialResult, interval: float) -> Film:
    """The motion: as the skill films it, else that of the trial's trace, at the rate that the trace has."""
    film = skill.film(goal, interval) if isinstance(skill, HasFilm) else None
    if film is None and result.trace is not None:
        film = Film(result.trace)
    if film is None:
        raise Invalid(f"nothing to draw: trials of {type(skill).__name__} have no motion (`TrialResult.trace`)")
    return film


def _exposure(artist: SceneRenderer, film: Film) -> Picture:
    """Six moments in one picture, solid at the one that matters and see-through at the others."""
    rows = _moments(film)
    return artist.exposure(rows, solid=rows[3])


def _strip(artist: SceneRenderer, film: Film) -> Picture:
    """Six moments side by side in two rows, numbered and with their times."""
    frames = [
        _captioned(artist.frame(row), f"{index + 1}   {film.trace.time[row]:.2f} s")
        for index, row in enumerate(_moments(film))
    ]
    return np.vstack([np.hstack(frames[:3]), np.hstack(frames[3:])])


def _save_picture(picture: Picture, path: Path) -> None:
    from PIL import Image

    with output_file(path) as partial:
        Image.fromarray(picture).save(partial)


def _moments(film: Film) -> list[int]:
    """Rows of the start, two before the moment that matters, that moment, one after it, and the end."""
    end = float(film.trace.time[-1])
    moment = 0.6 * end if film.moment is None else film.moment
    times = (0.0, 0.5 * moment, 0.85 * moment, moment, 0.5 * (moment + end), end)
    return [int(np.abs(film.trace.time - time).argmin()) for time in times]


def _captioned(picture: Picture, text: str) -> Picture:
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    size = picture.shape[0] / 16
    ImageDraw.Draw(image).text((size / 2, size / 2), text, fill=(20, 30, 40), font=ImageFont.load_default(size))
    return np.asarray(image)


def compared(trial: Trial, again: TrialResult) -> str:
    """Says whether a replayed trial had its first result again."""
    told_now = "no cost" if again.cost is None else f"cost {again.cost:.4f}"
    if _same(trial, again):
        return f"{again.reason}, {told_now}: to the bit what was measured then"
    before = trial.info.get("reason", "no reason")
    told = "no cost" if trial.cost is None else f"cost {trial.cost:.4f}"
    return (
        f"{again.reason}, {told_now}; the log says {before}, {told}: environment or skill differ "
        "(see --environment and --skill)"
    )


def _same(trial: Trial, again: TrialResult) -> bool:
    if trial.outcome is not None and again.outcome is not None:  # costs may have been corrected since
        return bool(np.array_equal(trial.outcome, again.outcome, equal_nan=True))
    return trial.cost == again.cost
