"""`crkr experiment rivals`: crkr beside its alternatives, on the same trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from crkr.client.cli.console import print_json
from crkr.client.cli.options import Json

__all__ = ["rivals"]

_FILE: Final = "rivals.csv"
_FIGURE: Final = "rivals.png"
_OURS: Final = "crkr"


def rivals(
    only: Annotated[list[str] | None, typer.Option("--only", help="A rival's name; may be repeated.")] = None,
    seeds: Annotated[int, typer.Option(min=1, max=10_000, help="Runs of each rival, one a seed.")] = 8,
    first_seed: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    trials: Annotated[
        list[int] | None, typer.Option("--trials", min=0, max=100_000, help="Judge after this many; may be repeated.")
    ] = None,
    contexts: Annotated[int, typer.Option(min=1, max=1_000_000, help="Fresh contexts of each judgement.")] = 300,
    judge: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of these contexts.")] = 777,
    demonstrations: Annotated[int, typer.Option(min=0, max=10_000, help="Demonstrations before the first trial.")] = 5,
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. wide.")] = None,
    environment: Annotated[str, typer.Option(help="Which simulator, e.g. contact.")] = "analytic",
    skill: Annotated[str, typer.Option(help="A skill, or your own as file.py:factory.")] = "table-tennis",
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes of this machine.")] = 2,
    on: Annotated[str, typer.Option("--on", help="Where runs are made: here or ray, a cluster.")] = "here",
    out: Annotated[Path | None, typer.Option(file_okay=False, help="Keep and go on with rivals.csv here.")] = None,
    json: Json = False,
) -> None:
    """Compare crkr with its alternatives.

    Every rival gets the same demonstrations, training contexts and judged
    contexts, and the outcome where it can use it. Some need the extra
    'rivals'; without --only, those that are installed take part. With --out,
    runs that the folder already holds are not made again.

    Example: crkr experiment rivals --launcher wide --trials 100 --trials 500
    """
    from importlib.util import find_spec

    from crkr.client.cli.error_lines import require
    from crkr.experiments.figures.curves import draw_summaries
    from crkr.experiments.rivals.comparison import PACKAGES, RIVALS, Contest
    from crkr.experiments.study.contest_runs import beside, make_runs
    from crkr.experiments.study.rows import Rows, comparison_cell, print_summary, summary_table
    from crkr.protocol import Invalid

    unknown = sorted(set(only or ()) - set(RIVALS))
    if unknown:
        raise Invalid(f"no rival {unknown[0]!r}; there are: {', '.join(RIVALS)}")
    require(*(PACKAGES[name] for name in only or () if name in PACKAGES))
    absent = {name for name, package in PACKAGES.items() if find_spec(package) is None}
    names = [name for name in RIVALS if name in (only or RIVALS.keys() - absent)]
    contest = Contest(tuple(sorted(set(trials or (100, 500)))), contexts, judge, demonstrations)
    settings = {
        "skill": skill, "launcher": launcher, "environment": environment, "contexts": contexts, "judge": judge,
        "demonstrations": demonstrations,
    }  # fmt: skip
    rows, ways = Rows(out, _FILE, settings), {name: RIVALS[name] for name in names}
    busy = make_runs(rows, settings, contest, ways, range(first_seed, first_seed + seeds), jobs, on)
    table = summary_table(rows.all, names, contest.marks)
    better, area = beside(rows, dict.fromkeys(names, _OURS), contest.marks[-1])
    title = f"{skill}, {launcher or 'its launcher'}, {environment}, {contexts} contexts"
    if out is not None and contest.marks[0] > 0:
        draw_summaries(table, title, out / _FIGURE)
    if json:
        print_json(
            [
                {**row, "ms": busy.get(row["way"]), "beside": better.get(row["way"]), "area": area.get(row["way"])}
                for row in table
            ]
        )
        return
    extra = {
        f"P(better than {_OURS})": lambda way: comparison_cell(better.get(way), "better"),
        "gain in area": lambda way: comparison_cell(area.get(way), "gain"),
        "ms a trial": lambda way: f"{busy[way]:.1f}" if way in busy else "",
    }
    print_summary(table, contest.marks, title, extra)
