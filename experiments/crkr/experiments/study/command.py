"""`crkr experiment study`: rules for the active set, budgets and trade-offs, with the same trials."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import typer

from crkr.client.cli.console import print_json, stderr
from crkr.client.cli.options import Json

if TYPE_CHECKING:
    from crkr.experiments.learning.run import Course
    from crkr.experiments.study.rows import Row
    from crkr.sim_worker.skill import Skill

__all__ = ["study"]

_FILE: Final = "study.csv"


class _Way(NamedTuple):
    """A rule with its settings."""

    selector: str
    budget: int
    tradeoff: float

    @property
    def name(self) -> str:
        """As it stands in the table."""
        return f"{self.selector}, budget {self.budget}, lambda {self.tradeoff:g}"


def study(
    only: Annotated[list[str] | None, typer.Option("--only", help="A selector's name; may be repeated.")] = None,
    budgets: Annotated[list[int] | None, typer.Option("--budget", min=1, help="May be repeated; 250.")] = None,
    tradeoffs: Annotated[list[float] | None, typer.Option("--lambda", min=0.0, help="May be repeated; 1.")] = None,
    seeds: Annotated[int, typer.Option(min=1, max=10_000, help="Runs of each way, one a seed.")] = 10,
    first_seed: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    trials: Annotated[int, typer.Option(min=1, max=100_000, help="Training trials of a run.")] = 1500,
    contexts: Annotated[int, typer.Option(min=1, max=1_000_000, help="Fresh contexts of the last judgement.")] = 300,
    judge: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of these contexts.")] = 777,
    demonstrations: Annotated[int, typer.Option(min=1, max=10_000, help="Demonstrations before the first trial.")] = 5,
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. wide.")] = None,
    environment: Annotated[str, typer.Option(help="Which simulator, e.g. contact.")] = "analytic",
    preset: Annotated[str, typer.Option(help="Which settings, e.g. tuned.")] = "paper",
    skill: Annotated[str, typer.Option(help="A skill, or package.module:factory.")] = "table-tennis",
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes of this machine.")] = 2,
    on: Annotated[str, typer.Option("--on", help="Where runs are made: here or ray, a cluster.")] = "here",
    out: Annotated[Path | None, typer.Option(file_okay=False, help="Keep rows in study.csv here, and go on.")] = None,
    json: Json = False,
) -> None:
    """Compare rules for the active set on the same trials.

    With --out, runs that the folder already holds are not made again.

    Example: crkr experiment study --only anms --only full --budget 50 --budget 250
    """
    from itertools import product

    from crkr.client.cli.progress import Progress
    from crkr.experiments.learning.run import Course
    from crkr.experiments.study.rows import Rows, print_summary, summary_table
    from crkr.experiments.study.selectors import RIVAL_SELECTORS
    from crkr.protocol import Invalid
    from crkr.sim_worker.places.places import load_places
    from crkr.sim_worker.skill import SkillOptions

    unknown = sorted(set(only or ()) - set(RIVAL_SELECTORS))
    if unknown:
        raise Invalid(f"no selector {unknown[0]!r}; there are: {', '.join(RIVAL_SELECTORS)}")
    names = [name for name in RIVAL_SELECTORS if not only or name in only]
    ways = {way.name: way for way in (_Way(*one) for one in product(names, budgets or [250], tradeoffs or [1.0]))}
    marks = tuple(mark for mark in (0, 50, 100, 200, 500, 1000) if mark < trials)
    settings = {
        "skill": skill,
        "launcher": launcher,
        "environment": environment,
        "preset": preset,
        "contexts": contexts,
        "judge": judge,
        "demonstrations": demonstrations,
    }
    rows = Rows(out, _FILE, settings)

    def part(way: _Way, seed: int) -> tuple[str, str, Course, int]:
        settings = (("budget", way.budget), ("regularisation", way.tradeoff))
        course = Course(trials, contexts, judge, demonstrations, marks, settings=settings)
        return way.name, way.selector, course, seed

    missing = rows.missing(ways, range(first_seed, first_seed + seeds), trials)
    parts = [part(ways[name], seed) for name, seed in missing]
    with Progress(stderr, "learning", len(parts), "runs") as progress:
        options = SkillOptions(environment=environment, launcher=launcher, preset=preset)
        spread = load_places(on).spread(skill, options, _learn, parts, jobs) if parts else iter(())
        for done, found in enumerate(spread, 1):
            rows.add(found)
            progress.show(done, f"{found[0].way}, seed {found[0].seed}", now=True)
    shown = (*marks[2:], trials)
    table = summary_table(rows.all, ways, shown)
    if json:
        print_json(table)
    else:
        title = f"{skill}, {launcher or 'its launcher'}, {environment}, preset {preset}"
        print_summary(table, shown, title, {})


def _learn(skill: Skill, part: tuple[str, str, Course, int]) -> list[Row]:
    from crkr.experiments.learning.run import learn_once
    from crkr.experiments.study.rows import judged_row
    from crkr.experiments.study.selectors import RIVAL_SELECTORS
    from crkr.sim_worker.guarded_skill import GuardedSkill

    name, selector, course, seed = part
    run = learn_once(GuardedSkill(skill), course, seed, RIVAL_SELECTORS[selector])
    early = [score for score in run.curve if score.trials < course.trials]
    return [judged_row(name, seed, score) for score in (*early, run.final)]
