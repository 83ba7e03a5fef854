"""`crkr experiment figure3 ...`: the figures of [Cardoso2017], by this learner and these simulators."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from crkr.client.cli.console import json_data, print_json, print_table, stderr, stdout
from crkr.client.cli.options import Json, Overwrite
from crkr.client.cli.output_file import check_output, output_file

if TYPE_CHECKING:
    from crkr.experiments.learning.run import LearningRun

__all__ = ["figure3", "figure4", "figure5", "figure7", "policy"]

Out = Annotated[Path, typer.Option(file_okay=False, help="Folder to save the figure in.")]
Seeds = Annotated[int, typer.Option(min=1, max=10_000, help="Runs of each curve, one a seed.")]
FirstSeed = Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")]
Trials = Annotated[int, typer.Option(min=1, max=100_000, help="Training trials of a run.")]
Balls = Annotated[int, typer.Option(min=1, max=1_000_000, help="Fresh contexts to evaluate each run on.")]
Jobs = Annotated[int, typer.Option(min=1, max=256, help="Processes.")]
HERE: Final = Path("figures")

_EPOCH: Final = 50  # training trials, and contexts of the fixed evaluation after them
_JUDGE: Final = 777
_DEMONSTRATIONS: Final = 5
_CRITERION: Final = "paper"
_SELECTORS: Final = {
    "anms": "ANMS keeps {budget} of all samples",
    "freeze": "the first {budget} samples",
    "full": "all samples",
}


def figure3(out: Out = HERE, overwrite: Overwrite = False) -> None:
    """Draw the kernel: two widths, and their product.

    Example: crkr experiment figure3 --out figures
    """
    from crkr.experiments.figures.method import draw_kernel

    draw_kernel(_file(out, "figure3.png", overwrite))
    stderr.print(f"{out / 'figure3.png'}: the squared-exponential kernel with a length-scale a dimension")


def figure4(
    out: Out = HERE,
    seed: Annotated[int, typer.Option(min=0, help="Of the states and draws.")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Draw how exploration narrows around good goals.

    Example: crkr experiment figure4 --out figures
    """
    from crkr.experiments.figures.method import draw_exploration, exploration_moments

    path = _file(out, "figure4.png", overwrite)
    moments = exploration_moments(seed)
    draw_exploration(moments, path)
    stderr.print(f"{out / 'figure4.png'}: a demonstration and {moments[-1].iterations} trials")


def figure5(
    out: Out = HERE,
    seeds: Seeds = 10,
    first_seed: FirstSeed = 0,
    trials: Trials = 1500,
    budget: Annotated[int, typer.Option(min=1, max=1000, help="Most active samples.")] = 250,
    balls: Balls = 200,
    jobs: Jobs = 2,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Compare learning past the budget with stopping at it and with no budget.

    Analytic table tennis with preset `paper`: ANMS selects from all samples,
    one rival keeps the first ones, another uses all.

    Example: crkr experiment figure5 --seeds 10 --jobs 2
    """
    settings = {label.format(budget=budget): {"selector": name, "budget": budget} for name, label in _SELECTORS.items()}
    title = f"Analytic table tennis: learning past a budget of {budget}"
    _epochs("figure5", "analytic", settings, title, out, overwrite, (seeds, first_seed, trials, balls, jobs), json)


def figure7(
    out: Out = HERE,
    seeds: Seeds = 5,
    first_seed: FirstSeed = 0,
    trials: Trials = 1500,
    tradeoffs: Annotated[str, typer.Option("--lambda", help="Values to compare, with commas.")] = "0.1,1,10",
    balls: Balls = 200,
    jobs: Jobs = 2,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Learn in simulated contact for several exploration-exploitation trade-offs lambda.

    Example: crkr experiment figure7 --lambda 0.1,1,10 --seeds 5 --jobs 2
    """
    from crkr.protocol import Invalid

    try:
        values = [float(word) for word in tradeoffs.split(",")]
    except ValueError as error:
        raise Invalid(f"--lambda takes numbers with commas between, e.g. 0.1,1,10; got {tradeoffs!r}") from error
    settings = {f"lambda {value:g}": {"regularisation": value} for value in values}
    title = "Simulated table tennis: the trade-off lambda"
    _epochs("figure7", "contact", settings, title, out, overwrite, (seeds, first_seed, trials, balls, jobs), json)


def policy(
    out: Out = HERE,
    vary: Annotated[str, typer.Option(help="State coordinate to vary.")] = "ball_y",
    seed: FirstSeed = 0,
    trials: Trials = 1500,
    preset: Annotated[str | None, typer.Option(help="Settings, e.g. paper.")] = None,
    environment: Annotated[str | None, typer.Option(help="Simulator, e.g. analytic.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Learn once, and draw the paddle's goals while one coordinate of the state varies.

    Example: crkr experiment policy --vary ball_y --environment analytic
    """
    from crkr.client.cli.progress import Progress
    from crkr.experiments.learning.run import Course, trained_learner
    from crkr.sim_worker.guarded_skill import GuardedSkill
    from crkr.sim_worker.pictures.policy_figure import draw_policy, varied
    from crkr.sim_worker.skill import SkillOptions
    from crkr.sim_worker.skill_registry import load_skill

    path = _file(out, "policy.png", overwrite)
    player = load_skill("table-tennis", SkillOptions(environment=environment, preset=preset))
    skill = GuardedSkill(player)
    with Progress(stderr, "learning", trials, "trials") as progress:
        learner = trained_learner(skill, Course(trials, 0, _JUDGE, _DEMONSTRATIONS), seed, progress.show)
    index, states = varied(learner.spec, vary, 31, None)
    answer = learner.predict(states)
    draw_policy(learner.spec, index, answer, player, path)
    stderr.print(f"{out / 'policy.png'}: after {trials} trials")


def _epochs(
    name: str,
    environment: str,
    settings: dict[str, dict[str, Any]],
    title: str,
    out: Path,
    overwrite: bool,
    size: tuple[int, int, int, int, int],
    as_json: bool,
) -> None:
    from crkr.experiments.figures.curves import draw_epochs
    from crkr.experiments.learning.many_runs import learn_many
    from crkr.experiments.learning.run import Course
    from crkr.sim_worker.skill import SkillOptions

    seeds, first_seed, trials, balls, jobs = size
    marks = tuple(range(0, trials, _EPOCH))
    chosen = range(first_seed, first_seed + seeds)
    courses = {
        label: Course(trials, balls, _JUDGE, _DEMONSTRATIONS, marks, _EPOCH, tuple(changes.items()))
        for label, changes in settings.items()
    }
    options = SkillOptions(environment=environment, preset="paper", traces=False)
    parts = [(course, seed) for course in courses.values() for seed in chosen]
    path, numbers = _file(out, f"{name}.png", overwrite), _file(out, f"{name}.json", overwrite)
    runs = learn_many("table-tennis", options, parts, jobs)
    ways = {label: runs[seeds * place : seeds * (place + 1)] for place, label in enumerate(courses)}
    draw_epochs(ways, _CRITERION, title, path)
    summaries = _summaries(ways)
    result = {"figure": name, "options": options, "trials": trials, "ways": summaries}
    _save(numbers, result)
    if as_json:
        print_json(result)
        return
    stdout.print(f"{path}: {seeds} runs a curve, judged on {balls} fresh contexts")
    rows = [
        [label, f"{way['mean']:.3f}", f"{way['worst']:.3f}", f"{way['best']:.3f}", way["filled"] or "never"]
        for label, way in summaries.items()
    ]
    print_table(["", "mean", "worst", "best", "budget filled after"], rows)


def _summaries(ways: dict[str, list[LearningRun]]) -> dict[str, dict[str, Any]]:
    import numpy as np

    found = {}
    for label, runs in ways.items():
        rates = [run.final.tally.rate(_CRITERION) for run in runs]
        filled = [run.filled for run in runs if run.filled is not None]
        found[label] = {
            "mean": float(np.mean(rates)),
            "worst": min(rates),
            "best": max(rates),
            "filled": round(float(np.mean(filled))) if len(filled) == len(runs) else None,
            "seeds": [run.seed for run in runs],
            "final": rates,
            "curve": {
                "trials": [score.trials for score in runs[0].curve],
                "rates": [[score.tally.rate(_CRITERION) for score in run.curve] for run in runs],
            },
            "digests": [run.digest for run in runs],
        }
    return found


def _file(out: Path, name: str, overwrite: bool) -> Path:
    """A path that can be written; checked before the work."""
    out.mkdir(parents=True, exist_ok=True)
    check_output(out / name, overwrite=overwrite)
    return out / name


def _save(path: Path, result: dict[str, Any]) -> None:
    import json as json_format

    with output_file(path) as partial:
        partial.write_text(json_format.dumps(json_data(result), indent=1) + "\n", encoding="utf-8")
