"""A picture or a film of one trial."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Invalid
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.rendering import Artist, save_film, save_picture, save_sequence
from crkr.sim_worker.table_tennis.simulation import Simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["render_trial"]

RATE: Final = 30  # frames a second of a film, at true speed


def render_trial(
    options: SkillOptions,
    seed: int,
    path: Path,
    *,
    ball: int = 0,
    goal: NDArray[np.float64] | None = None,
    width: int = 1280,
    height: int = 720,
    sequence: bool = False,
) -> str:
    """Draws the trial of one ball of an evaluation and saves it.

    Args:
        options: As for the skill.
        seed: Of the evaluation.
        path: A .png for one picture of several moments, a .mp4 or .gif for a film.
        ball: Which ball of the evaluation.
        goal: (13,) to draw; None is the planner's.
        width: [pixels].
        height: [pixels]; of each moment in a sequence.
        sequence: Show the moments of a .png one beside the other rather than in one picture.

    Returns:
        The trial's reason, e.g. "returned".

    Raises:
        Invalid: An unknown option or suffix, a goal that is refused, or a ball that the planner cannot return.
        Unsupported: This machine cannot render, or has no ffmpeg for a .mp4.
    """
    skill = TableTennis(options, traces=False)
    state = skill.reset(fresh_rng(seed, ball))
    if goal is None:
        plan = skill.plan(state)
        if plan is None:
            raise Invalid(f"the planner cannot return ball {ball} of seed {seed}; choose another")
        goal = plan[0]
    motion = skill.film(state, goal, 1 / RATE)
    reason = str(skill.attempt(state, goal).info["reason"])
    if motion is None:
        raise Invalid(f"nothing to draw: the goal is refused ({reason})")
    with Artist(Simulation(), width, height) as artist:
        if sequence:
            save_sequence(artist, motion, path)
        elif path.suffix == ".png":
            save_picture(artist, motion, path)
        else:
            save_film(artist, motion, path, RATE)
    return reason
