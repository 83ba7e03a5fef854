"""The trials of a page's film: the best and the worst of the log, replayed by the task's skill."""

from __future__ import annotations

import heapq
import logging
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from typing import Any, Final, Protocol, final

from crkr.dashboard.page.film import Film
from crkr.dashboard.page.markup import number
from crkr.dashboard.progress import Row
from crkr.protocol import CrkrError, Geom, StoredTrial, TaskSpec, Trace, Unsupported

__all__ = ["Extremes", "Goals", "PlayedTrial", "add_film", "play"]

logger = logging.getLogger(__name__)

GROUP: Final = "crkr.films"
"""Group of entry points; `skill` is called with the arguments of `play`."""

KEPT: Final = 8  # of each kind, as some may have no motion
KINDS: Final = ("trial", "evaluation")

Goals = Callable[[Any], Any]
"""A policy: the goal (p,) for a state (d,)."""


class PlayedTrial(Protocol):
    """A trial that was played for display and is not stored."""

    @property
    def seq(self) -> int | None:
        """Log position of a replayed trial; None for a new one."""

    @property
    def cost(self) -> float | None:
        """In [0, 1], or None."""

    @property
    def success(self) -> bool:
        """Whether it succeeded."""

    @property
    def reason(self) -> str:
        """How it ended."""

    @property
    def trace(self) -> Trace | None:
        """How things moved."""


@final
class Extremes:
    """The best and the worst executed trials of a run, the newest among equals.

    Attributes:
        best: Successes first, then by cost.
        worst: The other way round.
    """

    def __init__(self) -> None:
        self.best: list[Row] = []
        self.worst: list[Row] = []

    def add(self, rows: Sequence[Row]) -> None:
        """Consider trials."""
        tried = [row for row in rows if row.kind in KINDS and row.cost is not None and not row.stored.removed]
        self.best = heapq.nsmallest(KEPT, [*self.best, *tried], key=lambda row: (not row.success, row.cost, -row.seq))
        self.worst = heapq.nlargest(KEPT, [*self.worst, *tried], key=lambda row: (not row.success, row.cost, row.seq))


def play(
    skill: str | None, spec: TaskSpec, stored: Sequence[Sequence[StoredTrial]], goals: Goals | None
) -> tuple[Sequence[Geom], Sequence[PlayedTrial]]:
    """Play trials of a task by a skill.

    Args:
        skill: Its name; None: the installed skill that the task names.
        spec: Of the task.
        stored: Groups of trials; the first of each with a motion is replayed, if the skill can `restore` states.
        goals: The policy for new trials, if it cannot.

    Raises:
        Unsupported: No installed package plays skills.
        Invalid: There is no such skill, or it does not fit the task.
    """
    found = list(entry_points(group=GROUP, name="skill"))
    if not found:
        raise Unsupported("nothing that is installed plays skills: pip install 'crkr[sim]'")
    scene, trials = found[0].load()(skill, spec, stored, goals)
    return scene, trials


def add_film(film: Film, extremes: Extremes, skill: str | None, spec: TaskSpec, goals: Goals | None) -> None:
    """Play trials by a skill for a film; without a scene or motions it stays empty. Arguments and errors as for `play`.

    There is no film if no skill is named and the task's own cannot play.
    """
    rows = {row.seq: row for row in (*extremes.best, *extremes.worst)}
    stored = [[row.stored for row in kind] for kind in (extremes.best, extremes.worst)]
    try:
        scene, trials = play(skill, spec, stored, goals)
    except (CrkrError, ModuleNotFoundError) as error:
        if skill is not None:
            raise
        logger.info("no film: %s", error)
        return
    film.show(scene)
    for trial in trials:
        if trial.trace is None:
            continue
        row = None if trial.seq is None else rows[trial.seq]
        shown = trial if row is None else row
        film.add(_caption(trial, row), shown.success, shown.cost, 0.0, trial.trace)


def _caption(trial: PlayedTrial, row: Row | None) -> str:
    """A description of a played trial in one line."""
    shown = trial if row is None else row
    told = [] if row is None else [f"number {number(row.seq)} of the log"]
    told += [shown.reason, *([] if shown.cost is None else [f"cost {number(shown.cost, 2)}"])]
    if row is not None and trial.success != row.success:
        told.append(f"now {trial.reason}")
    return ", ".join(told)
