"""`crkr experiment labels`: a throw learned without demonstrations, from labels, costs, or outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from crkr.client.cli.console import print_json, print_table
from crkr.client.cli.options import Json

if TYPE_CHECKING:
    from crkr.learner import Learner
    from crkr.protocol import Array

__all__ = ["labels"]

_TOLERANCE: Final = 0.2  # [m]
_HEIGHT: Final = 1.0  # of the hand above the ground [m]
_GRAVITY: Final = 9.81  # [m/s^2]
_NEAREST: Final = 1.5  # target [m]
_FARTHEST: Final = 5.0
_MARKS: Final = (30, 100, 300, 1000)
_REPORTS: Final = ("label", "cost", "outcome")


def labels(
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs, one a seed.")] = 8,
    first_seed: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    trials: Annotated[int, typer.Option(min=1, max=10_000, help="Trials of a run.")] = 300,
    json: Json = False,
) -> None:
    """Learn to throw without demonstrations, from hit or miss alone, from a cost, and from the measured miss.

    The goal is speed and angle of a throw at a target 1.5 to 5 m away; a hit
    is 0.2 m or nearer. Each run is evaluated on 150 targets.

    Example: crkr experiment labels --seeds 5 --json
    """
    marks = [mark for mark in _MARKS if mark < trials] + [trials]
    found = {
        report: [_run(report, seed, marks) for seed in range(first_seed, first_seed + seeds)] for report in _REPORTS
    }
    rows = [
        {
            "report": report,
            "trials": mark,
            "mean": sum(run[mark] for run in runs) / seeds,
            "worst": min(run[mark] for run in runs),
            "runs": [run[mark] for run in runs],
        }
        for report, runs in found.items()
        for mark in marks
    ]
    if json:
        print_json({"seeds": seeds, "first_seed": first_seed, "hits": rows})
        return
    table = [(row["report"], row["trials"], f"{row['mean']:.3f}", f"{row['worst']:.3f}") for row in rows]
    print_table(("reported", "trials", "share of hits", "worst run"), table, f"a throw from nothing, {seeds} seeds")


def _run(report: str, seed: int, marks: Sequence[int]) -> dict[int, float]:
    """Share of hits after each number of trials."""
    import numpy as np

    from crkr.learner import Learner
    from crkr.protocol import TaskSpec, training_id

    rng = np.random.default_rng(seed)
    learner, found = Learner(TaskSpec.from_dict(_fields(report, seed))), {}
    for number in range(1, marks[-1] + 1):
        target = rng.uniform(_NEAREST, _FARTHEST, 1)
        answer = learner.predict(target, explore=True, trial_ids=training_id("toss", seed, 1, number))
        missed = float(_reach(answer.goals) - target[0])
        told: dict[str, Any] = {"cost": float(-np.expm1(-0.5 * (missed / _TOLERANCE) ** 2))}
        if report == "label":
            told = {}
        elif report == "outcome":
            told["outcome"] = [missed]
        learner.report(answer, success=abs(missed) <= _TOLERANCE, **told)
        if number in marks:
            found[number] = _hits(learner)
    return found


def _fields(report: str, seed: int) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "name": "toss",
        "seed": seed,
        "state": [{"name": "target", "unit": "m", "low": _NEAREST, "high": _FARTHEST}],
        "goal": [
            {"name": "speed", "unit": "m/s", "low": 1.0, "high": 9.0},
            {"name": "angle", "unit": "rad", "low": 0.2, "high": 1.4},
        ],
    }
    if report == "label":
        fields["cost"] = "label"
    elif report == "outcome":
        fields["outcome"] = [{"name": "miss", "unit": "m", "tolerance": _TOLERANCE}]
    return fields


def _hits(learner: Learner) -> float:
    import numpy as np

    from crkr.protocol import NoSamples

    targets = np.linspace(_NEAREST + 0.05, _FARTHEST - 0.05, 150)[:, None]
    try:
        goals = learner.predict(targets).goals
    except NoSamples:  # not one hit yet
        return 0.0
    return float((np.abs(_reach(goals) - targets[:, 0]) <= _TOLERANCE).mean())


def _reach(goals: Array) -> Array:
    """Where throws (..., 2) come down [m]."""
    import numpy as np

    speed, angle = goals[..., 0], goals[..., 1]
    forward, up = speed * np.cos(angle), speed * np.sin(angle)
    return np.asarray(forward * (up + np.sqrt(up * up + 2 * _GRAVITY * _HEIGHT)) / _GRAVITY)
