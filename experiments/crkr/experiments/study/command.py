"""`crkr experiment study` and `ablation`: compare selection rules, and parts of the learner, on the same trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Json

if TYPE_CHECKING:
    from crkr.experiments.study.rows import Rows

__all__ = ["ablation", "study"]

_MARKS: Final = (100, 200, 500, 1000)

Only = Annotated[list[str] | None, typer.Option("--only", help="A name; may be repeated.")]
Seeds = Annotated[int, typer.Option(min=1, max=10_000, help="Runs of each way, one a seed.")]
FirstSeed = Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")]
Trials = Annotated[int, typer.Option(min=1, max=100_000, help="Training trials of a run.")]
Contexts = Annotated[int, typer.Option(min=1, max=1_000_000, help="Fresh contexts of each judgement.")]
Judge = Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of these contexts.")]
Demonstrations = Annotated[int, typer.Option(min=1, max=10_000, help="Demonstrations before the first trial.")]
Criterion = Annotated[str | None, typer.Option(help="Of success, e.g. paper; the strictest unless told.")]
Launcher = Annotated[str | None, typer.Option(help="Where contexts come from, e.g. wide.")]
Environment = Annotated[str, typer.Option(help="Which simulator, e.g. contact.")]
Preset = Annotated[str, typer.Option(help="Which settings, e.g. tuned.")]
SkillName = Annotated[str, typer.Option("--skill", help="A skill, or your own as file.py:factory.")]
Jobs = Annotated[int, typer.Option(min=1, max=256, help="Processes of this machine.")]
On = Annotated[str, typer.Option("--on", help="Where runs are made: here or ray, a cluster.")]
Out = Annotated[Path | None, typer.Option(file_okay=False, help="Keep rows in a CSV file here, and go on.")]


def study(
    only: Only = None,
    budgets: Annotated[list[int] | None, typer.Option("--budget", min=1, help="May be repeated; 250.")] = None,
    tradeoffs: Annotated[list[float] | None, typer.Option("--lambda", min=0.0, help="May be repeated; 1.")] = None,
    seeds: Seeds = 10,
    first_seed: FirstSeed = 0,
    trials: Trials = 1000,
    contexts: Contexts = 200,
    judge: Judge = 777,
    demonstrations: Demonstrations = 5,
    criterion: Criterion = None,
    launcher: Launcher = None,
    environment: Environment = "analytic",
    preset: Preset = "paper",
    skill: SkillName = "table-tennis",
    jobs: Jobs = 2,
    on: On = "here",
    out: Out = None,
    costs: Annotated[bool, typer.Option(help="Instead, time a trial of each way by the samples there are.")] = False,
    json: Json = False,
) -> None:
    """Compare rules for the active set, and approximations, on the same trials.

    Each is compared with ANMS of the same budget and lambda, seed by seed.
    With --out, runs that the folder already holds are not made again.

    Example: crkr experiment study --only anms --only full --budget 50 --budget 250
    """
    from itertools import product

    from crkr.experiments.study.approximators import RULES, Way
    from crkr.protocol import Invalid

    unknown = sorted(set(only or ()) - set(RULES))
    if unknown:
        raise Invalid(f"no selector {unknown[0]!r}; there are: {', '.join(RULES)}")
    names = [name for name in RULES if not only or name in only]
    grid = list(product(budgets or [250], tradeoffs or [1.0]))
    if costs:
        from crkr.experiments.study.costs import print_costs

        print_costs(names, [budget for budget, _ in grid])
        return
    ways = {way.name: way for way in (Way(name, *one) for name, one in product(names, grid))}
    rivals = {name: Way("anms", way.budget, way.tradeoff).name for name, way in ways.items()}
    settings = {
        "skill": skill, "launcher": launcher, "environment": environment, "preset": preset, "contexts": contexts,
        "judge": judge, "demonstrations": demonstrations, "criterion": criterion,
    }  # fmt: skip
    rows, marks = _run("study.csv", settings, ways, range(first_seed, first_seed + seeds), trials, (jobs, on, out))
    table = _shown(rows, marks, rivals, settings, out and out / "study.png", as_json=json)
    if json:
        print_json(table)
    elif len(grid) > 1:
        _print_overall(rows, names, [Way("anms", *one) for one in grid], trials)


def ablation(
    only: Only = None,
    seeds: Seeds = 8,
    first_seed: FirstSeed = 0,
    trials: Trials = 500,
    contexts: Contexts = 200,
    judge: Judge = 777,
    demonstrations: Demonstrations = 5,
    criterion: Criterion = None,
    launcher: Launcher = None,
    environment: Environment = "analytic",
    skill: SkillName = "table-tennis",
    jobs: Jobs = 2,
    on: On = "here",
    out: Out = None,
    json: Json = False,
) -> None:
    """Learn with one part of the learner left out or changed, and compare with the whole.

    With --out, runs that the folder already holds are not made again.

    Example: crkr experiment ablation --launcher wide --only "no outcome" --only "no scoring"
    """
    from crkr.experiments.study.ablations import ABLATIONS, WHOLE
    from crkr.protocol import Invalid

    unknown = sorted(set(only or ()) - set(ABLATIONS))
    if unknown:
        raise Invalid(f"no ablation {unknown[0]!r}; there are: {', '.join(ABLATIONS)}")
    ways = {name: change for name, change in ABLATIONS.items() if not only or name in only}
    settings = {
        "skill": skill, "launcher": launcher, "environment": environment, "preset": "tuned", "contexts": contexts,
        "judge": judge, "demonstrations": demonstrations, "criterion": criterion,
    }  # fmt: skip
    rows, marks = _run("ablation.csv", settings, ways, range(first_seed, first_seed + seeds), trials, (jobs, on, out))
    table = _shown(rows, marks, dict.fromkeys(ways, WHOLE), settings, out and out / "ablation.png", as_json=json)
    if json:
        print_json(table)


def _run(
    file: str,
    settings: Mapping[str, Any],
    ways: Mapping[str, Any],
    seeds: Sequence[int],
    trials: int,
    places: tuple[int, str, Path | None],
) -> tuple[Rows, tuple[int, ...]]:
    """Makes the runs that are missing; returns all rows, and the marks."""
    from crkr.experiments.rivals.comparison import Contest
    from crkr.experiments.study.contest_runs import make_runs
    from crkr.experiments.study.rows import Rows

    jobs, on, out = places
    marks = (*(mark for mark in _MARKS if mark < trials), trials)
    judged = (settings["contexts"], settings["judge"], settings["demonstrations"], settings["criterion"])
    rows = Rows(out, file, settings)
    make_runs(rows, settings, Contest(marks, *judged), ways, seeds, jobs, on)
    return rows, marks


def _shown(
    rows: Rows,
    marks: tuple[int, ...],
    rivals: Mapping[str, str],
    settings: Mapping[str, Any],
    figure: Path | None,
    *,
    as_json: bool,
) -> list[dict[str, Any]]:
    """The table of all ways, each beside its rival; printed unless it is wanted as JSON, and drawn."""
    from crkr.experiments.figures.curves import draw_gains
    from crkr.experiments.study.contest_runs import beside
    from crkr.experiments.study.rows import comparison_cell, print_summary, summary_table

    table, (last, area) = summary_table(rows.all, rivals, marks), beside(rows, rivals, marks[-1])
    gains = {way: found.gain for way, found in last.items() if found is not None}
    title = ", ".join(str(settings[name]) for name in ("skill", "launcher", "environment", "preset") if settings[name])
    if figure is not None and gains:
        draw_gains(gains, f"{title}: after {marks[-1]} trials", figure)
    if not as_json:
        extra = {
            "gain": lambda way: comparison_cell(last.get(way), "gain"),
            "P(better)": lambda way: comparison_cell(last.get(way), "better"),
            "gain in area": lambda way: comparison_cell(area.get(way), "gain"),
        }
        print_summary(table, marks, f"{title}, {settings['contexts']} contexts", extra)
    return [{**row, "beside": last.get(row["way"]), "area": area.get(row["way"])} for row in table]


def _print_overall(rows: Rows, names: Sequence[str], anms: Sequence[Any], trials: int) -> None:
    """Each rule beside ANMS over all budgets and lambdas, which are the strata."""
    from crkr.experiments.study.rows import compare, comparison_cell

    lines = []
    for name in names:
        pairs = [(one._replace(rule=name).name, one.name) for one in anms]
        last, area = compare(rows.all, pairs, trials), compare(rows.all, pairs, trials, area=True)
        lines.append(
            (
                name,
                comparison_cell(last, "gain"),
                comparison_cell(last, "better"),
                comparison_cell(area, "gain"),
                last and last.seeds,
            )
        )
    stdout.print("over all budgets and lambdas, beside ANMS")
    print_table(("rule", "gain", "P(better)", "gain in area", "pairs"), [line for line in lines if line[0] != "anms"])
