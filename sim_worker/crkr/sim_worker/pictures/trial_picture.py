"""A picture or a film of one trial: planned, proposed by a policy, or stored and played again."""

from __future__ import annotations

from pathlib import Path
from typing import Final
from uuid import UUID

import numpy as np
from numpy.typing import NDArray

from crkr.client import Task
from crkr.protocol import Invalid, Trial
from crkr.sim_worker.pictures.film import FILMS, save_film
from crkr.sim_worker.pictures.renderer import SceneRenderer, save_picture, save_sequence
from crkr.sim_worker.randomness import fresh_rng
from crkr.sim_worker.skill import TrialResult
from crkr.sim_worker.table_tennis.scene import make_simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["check_kind", "compared", "planned", "render_trial", "stored_trial"]

Floats = NDArray[np.float64]

SHAPE: Final = (6, 13)  # numbers of a state and of a goal of table tennis
PICTURE_INTERVAL: Final = 0.01  # between points of the ball's path in a picture [s]
RATE: Final = 25  # frames a second: a GIF, which counts in hundredths of a second, can keep it


def check_kind(path: Path, *, sequence: bool = False, slow: float = 1.0) -> None:
    """Raises `Invalid`, before anything is drawn, where nothing could be saved at `path`."""
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
) -> TrialResult:
    """Plays a goal against a ball, draws it and saves what was drawn.

    Args:
        skill: Plays, in the environment that it was made with.
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
        raise Invalid(f"nothing to draw, as nothing moved: the goal is refused ({outcome.info['reason']})")
    with SceneRenderer(make_simulation(), width, height) as artist:
        if sequence:
            save_sequence(artist, motion, path)
        elif path.suffix == ".png":
            save_picture(artist, motion, path)
        else:
            save_film(artist.frames(motion), path, RATE)
    return outcome


def stored_trial(task: Task, trial_id: UUID) -> Trial:
    """The trial of that id in the log of a task of table tennis.

    Raises:
        Invalid: The task has other states or goals, or no such trial.
    """
    shape = len(task.spec.state), len(task.spec.goal)
    if shape != SHAPE:
        raise Invalid(f"table tennis has states of {SHAPE[0]} and goals of {SHAPE[1]}; task {task.name!r} has {shape}")
    for stored in task.iter_samples():
        if stored.trial.id == trial_id:
            return stored.trial
    raise Invalid(f"task {task.name!r} has no trial {trial_id}; crkr explain and the dashboard show ids")


def compared(trial: Trial, again: TrialResult) -> str:
    """Says whether playing a trial again gave what was measured the first time."""
    reason, cost = again.info["reason"], again.cost
    if _same(trial, again):
        return f"{reason}, cost {cost:.4f}: to the bit what was measured then"
    before = trial.info.get("reason", "no reason")
    told = "no cost" if trial.cost is None else f"cost {trial.cost:.4f}"
    return (
        f"{reason}, cost {cost:.4f}; the log says {before}, {told}: environment or skill differ "
        "(see --environment and --skill)"
    )


def _same(trial: Trial, again: TrialResult) -> bool:
    if trial.outcome is not None and again.outcome is not None:  # costs may have been corrected since
        return bool(np.array_equal(trial.outcome, again.outcome, equal_nan=True))
    return trial.cost == again.cost
