"""`crkr predict`, `crkr report` and `crkr explain`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Annotated
from uuid import UUID, uuid4

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stderr, stdout
from crkr.client.cli.options import Json, TaskName, check_count, connected, parse_ids, parse_vector
from crkr.protocol import Prediction, SampleExplanation, TaskSpec

__all__ = ["explain", "predict", "report"]

_State = Annotated[str, typer.Option("--state", help='The state, in quotes: "0.1 0.2".')]


@connected(5.0)
def predict(
    client: Client,
    task: TaskName,
    state: _State,
    explore: Annotated[
        bool, typer.Option("--explore", help="Draw a goal to try instead of the best known one.")
    ] = False,
    trial_id: Annotated[
        str | None, typer.Option("--id", metavar="UUID", help="Id of the trial to come, which fixes the draw.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Ask which goal to try in a state.

    Example: crkr predict table-tennis --state "0.5 0.1 1.0 -5 0 1.2" --explore
    """
    numbers = parse_vector(state, "--state")
    ids: list[UUID] | None = None if trial_id is None else parse_ids([trial_id])
    handle = client.task(task)
    spec = handle.spec
    _check_state(numbers, spec)
    answer = handle.predict(numbers, explore, trial_ids=ids)
    if as_json:
        print_json(_prediction_data(answer))
    else:
        _show_prediction(answer, spec)


@connected(5.0)
def report(
    client: Client,
    task: TaskName,
    state: _State,
    goal: Annotated[str, typer.Option("--goal", help="The executed goal, in quotes.")],
    success: Annotated[bool, typer.Option("--success/--failure", "--hit/--miss", help="Whether the trial succeeded.")],
    cost: Annotated[
        float | None,
        typer.Option("--cost", help="In [0, 1]; omitted for kind failed, and where the task learns from labels."),
    ] = None,
    kind: Annotated[str, typer.Option("--kind", help="trial, demonstration, evaluation or failed.")] = "trial",
    learn: Annotated[
        bool | None,
        typer.Option("--learn/--ignore", help="Whether goals may be learned from it; the task decides unless given."),
    ] = None,
    outcome: Annotated[str | None, typer.Option("--outcome", help="Measured numbers; nan means not observed.")] = None,
    trial_id: Annotated[
        str | None, typer.Option("--id", metavar="UUID", help="The trial's id, from `crkr predict`.")
    ] = None,
    worker: Annotated[str | None, typer.Option("--worker", help="Name of the reporting process.")] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Wait until the model includes it.")] = False,
    as_json: Json = False,
) -> None:
    """Store the cost of an executed goal; it is on the server's disk when the command returns.

    Example: crkr report throw --state "0.3 1.2" --goal "3.4 0.25" --cost 0.12 --success
    """
    numbers, aim = parse_vector(state, "--state"), parse_vector(goal, "--goal")
    measured = None if outcome is None else parse_vector(outcome, "--outcome")
    identifier = uuid4() if trial_id is None else parse_ids([trial_id])[0]
    handle = client.task(task)
    _check_state(numbers, handle.spec)
    check_count(aim, "--goal", handle.spec.goal)
    receipt = handle.report(
        state=numbers,
        goal=aim,
        cost=cost,
        success=success,
        kind=kind,
        id=identifier,
        outcome=measured,
        worker=worker,
        learn=learn,
        wait=wait,
    )
    if as_json:
        print_json({**asdict(receipt), "ids": [identifier]})
    else:
        what = "stored" if receipt.accepted else "known already"
        stdout.print(f"{what}: number {receipt.seqs[0]}; the model is at {receipt.model_version}")
        stdout.print(f"trial id {identifier}")


@connected(5.0)
def explain(
    client: Client,
    task: TaskName,
    state: _State,
    sample: Annotated[str | None, typer.Option("--sample", metavar="UUID", help="Id of a sample to explain.")] = None,
    as_json: Json = False,
) -> None:
    """Show what an answer is based on and how likely it succeeds, and why a sample is or is not in the model.

    Example: crkr explain throw --state "0.3 1.2"
    """
    numbers = parse_vector(state, "--state")
    sample_id = None if sample is None else parse_ids([sample])[0]
    handle = client.task(task)
    _check_state(numbers, handle.spec)
    answer = handle.explain(numbers, sample_id)
    if as_json:
        print_json(answer)
        return
    if answer.summary:
        stdout.print(answer.summary)
    print_table(
        ("sample", "weight", "cost", "distance"),
        [(n.id, f"{n.weight:+.4f}", f"{n.cost:.4f}", f"{n.distance:.3f}") for n in answer.neighbours],
    )
    stdout.print(f"novelty {answer.novelty:.3f}; distances in length-scales")
    if answer.sample is not None:
        stdout.print(_sentence(answer.sample))


def _check_state(state: Sequence[float], spec: TaskSpec) -> None:
    """Refuse another count of numbers, and warn of numbers outside their box."""
    check_count(state, "--state", spec.state)
    for axis, value in zip(spec.state, state, strict=True):
        if not axis.low <= value <= axis.high:
            box = f"{axis.low:g} to {axis.high:g}{f' {axis.unit}' if axis.unit else ''}"
            stderr.print(f"warning: {axis.name} is {value:g}, outside its box of {box}; goals there are guesses")


def _prediction_data(answer: Prediction) -> dict[str, object]:
    names = (
        "goal", "mean", "sigma", "novelty", "success_probability", "trial_id", "model_version", "active", "policy",
    )  # fmt: skip
    data = {name: getattr(answer, name) for name in names}
    if answer.predicted_outcome is not None:
        data |= {name: getattr(answer, name) for name in ("predicted_outcome", "predicted_outcome_sd")}
    return data


def _show_prediction(answer: Prediction, spec: TaskSpec) -> None:
    columns = zip(spec.goal, answer.goal, answer.mean, answer.sigma, strict=True)
    print_table(
        ("goal", "value", "unit", "mean", "sigma"),
        [(axis.name, f"{goal:.5g}", axis.unit, f"{mean:.5g}", f"{sd:.3g}") for axis, goal, mean, sd in columns],
    )
    if answer.predicted_outcome is not None and answer.predicted_outcome_sd is not None:
        expected = zip(spec.outcome, answer.predicted_outcome, answer.predicted_outcome_sd, strict=True)
        print_table(
            ("outcome", "expected", "unit", "sd", "target", "tolerance"),
            [
                (one.name, f"{value:.3g}", one.unit, f"{sd:.2g}", f"{one.target:g}", f"{one.tolerance:g}")
                for one, value, sd in expected
            ],
        )
    if answer.success_probability is not None:
        chance = float(answer.success_probability)
        known = f"succeeds with probability {chance:.2f}"
        stdout.print("how likely it succeeds is not known: nothing near was tried" if math.isnan(chance) else known)
    stdout.print(
        f"novelty {float(answer.novelty):.3f}, policy {answer.policy}, {answer.active} active samples, "
        f"model {answer.model_version}"
    )
    stdout.print(f"trial id {answer.trial_id}")


def _sentence(sample: SampleExplanation) -> str:
    if not sample.eligible:
        return f"{sample.id} is not learned from"
    place = "is in the model" if sample.active else "is not in the model"
    if sample.suppressor is None:
        return f"{sample.id} {place}; no sample near it is better"
    radius = "" if sample.radius is None else f", {sample.radius:.3f} length-scales away"
    return f"{sample.id} {place}; the nearest better sample is {sample.suppressor}{radius}"
