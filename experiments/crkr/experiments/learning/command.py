"""`crkr experiment learning`: success of learning over many seeds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from crkr.client.cli.console import json_data, print_json, print_table, stderr, stdout
from crkr.client.cli.options import Json, Overwrite
from crkr.client.cli.output_file import check_output, output_file

if TYPE_CHECKING:
    from crkr.experiments.learning.many_runs import Summary
    from crkr.experiments.learning.run import Course, LearningRun
    from crkr.sim_worker.skill import SkillOptions

__all__ = ["learning"]

_FILES: Final = ("learning.json", "learning.png")


def learning(
    seeds: Annotated[int, typer.Option(min=1, max=10_000, help="Runs, one a seed.")] = 10,
    first_seed: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    trials: Annotated[int, typer.Option(min=1, max=1_000_000, help="Training trials of a run.")] = 1500,
    contexts: Annotated[
        int, typer.Option("--contexts", "--balls", min=1, max=1_000_000, help="Fresh contexts to evaluate each run on.")
    ] = 1000,
    judge: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Seed of these contexts.")] = 777,
    demonstrations: Annotated[int, typer.Option(min=0, max=10_000, help="Demonstrations before the first trial.")] = 5,
    launcher: Annotated[str | None, typer.Option(help="Where contexts come from, e.g. nominal.")] = None,
    environment: Annotated[str | None, typer.Option(help="Which simulator, e.g. contact.")] = None,
    preset: Annotated[str | None, typer.Option(help="Which settings, e.g. tuned.")] = None,
    skill: Annotated[str, typer.Option(help="A skill, or your own as file.py:factory.")] = "table-tennis",
    oracle: Annotated[bool, typer.Option(help="Play the same contexts by the skill's planner.")] = True,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes of this machine.")] = 2,
    on: Annotated[str, typer.Option("--on", help="Where runs are made: here or ray, a cluster.")] = "here",
    out: Annotated[Path | None, typer.Option(file_okay=False, help="Save learning.png and learning.json here.")] = None,
    overwrite: Overwrite = False,
    json: Json = False,
) -> None:
    """Learn a skill with several seeds, and evaluate each run.

    No server is needed: each run has a learner in its own process. The same
    options give the same figures, whatever --jobs is.

    Example: crkr experiment learning --launcher medium --demonstrations 20 --seeds 3
    """
    from crkr.experiments.learning.many_runs import learn_many
    from crkr.experiments.learning.run import MARKS, Course
    from crkr.sim_worker.skill import SkillOptions

    if out is not None:  # before the work
        out.mkdir(parents=True, exist_ok=True)
        for name in _FILES:
            check_output(out / name, overwrite=overwrite)
    options = SkillOptions(environment=environment, launcher=launcher, preset=preset, traces=False)
    course = Course(trials, contexts, judge, demonstrations, MARKS if out is not None else ())
    runs = learn_many(skill, options, [(course, seed) for seed in range(first_seed, first_seed + seeds)], jobs, on)
    planner = _planner(skill, options, course, jobs) if oracle else {}
    result = _result(skill, options, course, runs, planner)
    if out is not None:
        _save(out, result, runs, planner)
    if json:
        print_json(result)
    else:
        _print(result)


def _planner(skill: str, options: SkillOptions, course: Course, jobs: int) -> dict[str, float]:
    """The planner's rates on the contexts of the evaluation; empty where the skill has no planner."""
    from crkr.client.cli.progress import Progress
    from crkr.sim_worker.evaluation.assessment import play_oracle
    from crkr.sim_worker.skill import HasPlanner
    from crkr.sim_worker.skill_registry import load_skill

    if not isinstance(load_skill(skill, options), HasPlanner):
        return {}
    with Progress(stderr, "planning", course.contexts, "contexts") as progress:
        won = play_oracle(skill, options, course.contexts, course.judge, jobs=jobs, show=progress.show)
    return won.rates()


def _result(
    skill: str, options: SkillOptions, course: Course, runs: list[LearningRun], planner: dict[str, float]
) -> dict[str, Any]:
    from crkr.experiments.learning.many_runs import summarise

    criteria = dict.fromkeys(name for run in runs for name in run.final.tally.criteria)
    return {
        "skill": skill,
        "options": options,
        "course": course,
        "summary": {name: summarise(runs, name, planner.get(name)) for name in criteria},
        "runs": [run.to_dict() for run in runs],
    }


def _save(out: Path, result: dict[str, Any], runs: list[LearningRun], planner: dict[str, float]) -> None:
    import json as json_format

    from crkr.experiments.figures.curves import draw_learning

    numbers, figure = (out / name for name in _FILES)
    with output_file(numbers) as partial:
        partial.write_text(json_format.dumps(json_data(result), indent=1) + "\n", encoding="utf-8")
    draw_learning(runs, planner, _title(result), figure)


def _title(result: dict[str, Any]) -> str:
    options, course = result["options"], result["course"]
    chosen = [name for name in (options.launcher, options.environment, options.preset) if name]
    return ", ".join([result["skill"], *chosen, f"{course.demonstrations} demonstrations"])


def _print(result: dict[str, Any]) -> None:
    course: Course = result["course"]
    summaries: dict[str, Summary] = result["summary"]
    stdout.print(f"{_title(result)}: {len(result['runs'])} runs of {course.trials} trials, {course.contexts} contexts")
    rows = [
        (
            name,
            f"{one.mean:.4f}",
            "" if one.interval is None else f"{one.interval[0]:.4f} to {one.interval[1]:.4f}",
            f"{one.worst:.4f} (seed {one.worst_seed})",
            "" if one.oracle is None else f"{one.oracle:.4f}",
        )
        for name, one in summaries.items()
    ]
    print_table(("success by", "mean", "95 % of the mean", "worst run", "planner"), rows)
