"""A picture or a film of one trial."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Invalid
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import Outcome
from crkr.sim_worker.table_tennis.environments.simulation import Simulation
from crkr.sim_worker.table_tennis.pictures.film import FILMS, save_film
from crkr.sim_worker.table_tennis.pictures.renderer import Artist, save_picture, save_sequence
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["check_kind", "planned", "render_trial"]

Floats = NDArray[np.float64]

PICTURE_INTERVAL: Final = 0.01  # between points of the ball's path in a picture [s]
RATE: Final = 25  # frames a second: a GIF, which counts in hundredths of a second, can keep it


def check_kind(path: Path, *, sequence: bool = False, slow: float = 1.0) -> None:
    """Raises `Invalid` now rather than after the drawing if nothing could be saved at `path`."""
    if sequence and path.suffix != ".png":
        raise Invalid(f"a sequence of moments is a .png; got {path.name}")
    if path.suffix not in (".png", *FILMS):
        raise Invalid(f"a picture is a .png, a film a .mp4 or a .gif; got {path.name}")
    if slow != 1.0 and path.suffix not in FILMS:
        raise Invalid(f"only a film, a .mp4 or a .gif, can be slow; {path.name} is a picture")
    if not path.absolute().parent.is_dir():
        raise Invalid(f"there is no folder {path.parent}; make it first")


def planned(skill: TableTennis, seed: int, ball: int) -> tuple[Floats, Floats]:
    """State (6,) and the planner's goal (13,) for one ball of an evaluation.

    Raises:
        Invalid: The planner cannot return it.
    """
    state = skill.reset(fresh_rng(seed, ball))
    plan = skill.plan(state)
    if plan is None:
        raise Invalid(f"the planner cannot return ball {ball} of seed {seed}; choose another")
    return state, plan[0]


def render_trial(
    skill: TableTennis,
    state: Floats,
    goal: Floats,
    path: Path,
    *,
    width: int = 1280,
    height: int = 720,
    sequence: bool = False,
    slow: float = 1.0,
) -> Outcome:
    """Plays a goal against a ball, draws it and saves what was drawn.

    Args:
        skill: Who plays, in the environment that it was made with.
        state: (6,) the ball at the snapshot.
        goal: (13,) to try.
        path: A .png for one picture of several moments, a .mp4 or .gif for a film.
        width: [pixels].
        height: [pixels]; of each moment in a sequence.
        sequence: Show the moments of a .png one beside the other rather than in one picture.
        slow: How many times slower than life a film runs; 1 for a .png.

    Returns:
        What the trial gave.

    Raises:
        Invalid: Another suffix, what files of that suffix cannot show, no such folder, or a goal that is refused.
        Unsupported: This machine cannot render.
        ModuleNotFoundError: PyAV is not installed, for an .mp4.
    """
    check_kind(path, sequence=sequence, slow=slow)
    motion = skill.film(state, goal, PICTURE_INTERVAL if path.suffix == ".png" else 1 / (RATE * slow))
    outcome = skill.attempt(state, goal)
    if motion is None:
        raise Invalid(f"nothing to draw, for nothing moved: the goal is refused ({outcome.info['reason']})")
    with Artist(Simulation(), width, height) as artist:
        if sequence:
            save_sequence(artist, motion, path)
        elif path.suffix == ".png":
            save_picture(artist, motion, path)
        else:
            save_film(artist.frames(motion), path, RATE)
    return outcome
