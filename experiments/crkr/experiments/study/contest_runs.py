"""Runs of ways to learn on the same trials, in processes or on a cluster; a folder keeps them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from statistics import median
from typing import Any

from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress
from crkr.experiments.rivals.comparison import Contest, train
from crkr.experiments.rivals.rival import Rival
from crkr.experiments.study.rows import Comparison, Row, Rows, compare
from crkr.protocol import TaskSpec
from crkr.sim_worker.places.places import load_places
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.supervisor.pool import ProcessLost

__all__ = ["beside", "make_runs"]

Maker = Callable[[TaskSpec, int], Rival]


def make_runs(
    rows: Rows, settings: Mapping[str, Any], contest: Contest, ways: Mapping[str, Maker], seeds: Sequence[int],
    jobs: int, on: str,
) -> dict[str, float]:  # fmt: skip
    """Makes missing runs, and repeats those of a dead process once.

    Args:
        rows: Where they are kept, in order at the end.
        settings: `skill`, `environment`, `launcher` and `preset`.
        contest: The common conditions.
        ways: Name -> function that makes a learner.
        seeds: One for each run of each way.
        jobs: How many processes.
        on: Where: "here" or "ray".

    Returns:
        The median processor time of a trial by way [ms], of the ways that had a run to make.
    """
    options = SkillOptions(settings["environment"], settings["launcher"], settings.get("preset"), traces=False)
    busy: dict[str, list[float]] = {}
    for attempt in (1, 2):
        parts = [(contest, name, ways[name], seed) for name, seed in rows.missing(ways, seeds, contest.marks[-1])]
        if not parts:
            break
        with Progress(stderr, "learning", len(parts), "runs") as progress:
            try:
                made = load_places(on).spread(settings["skill"], options, _learn, parts, jobs)
                for done, (found, milliseconds) in enumerate(made, 1):
                    rows.add(found)
                    busy.setdefault(found[0].way, []).append(milliseconds)
                    progress.show(done, f"{found[0].way}, seed {found[0].seed}", now=True)
            except ProcessLost as error:
                missing = list(rows.missing(ways, seeds, contest.marks[-1]))
                first = "; ".join(f"{name}, seed {seed}" for name, seed in missing[:jobs])
                told = f"a process was lost with {len(missing)} runs not made, in one of the first: {first}; {settings}"
                if attempt == 2:
                    raise ProcessLost(told) from error
                stderr.print(f"{told}; trying once more")
    rows.sort()
    return {name: median(found) for name, found in busy.items()}


def _learn(skill: Skill, part: tuple[Contest, str, Maker, int]) -> tuple[list[Row], float]:
    contest, name, make, seed = part
    return train(skill, contest, make(skill.spec(), seed), name, seed)


def beside(rows: Rows, rivals: Mapping[str, str], trials: int) -> tuple[dict[str, Comparison | None], ...]:
    """Each way beside another, after some trials and by the area under their curves; `rivals` is way -> other."""
    pairs = {way: [(way, rival)] for way, rival in rivals.items() if way != rival}
    return tuple(
        {way: compare(rows.all, pair, trials, area=area) for way, pair in pairs.items()} for area in (False, True)
    )
