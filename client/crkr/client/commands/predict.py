"""`crkr predict`."""

from __future__ import annotations

from typing import Annotated
from uuid import UUID

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig, check_count, parse_ids, parse_vector
from crkr.protocol import Prediction, TaskSpec

__all__ = ["predict"]


def predict(
    task: Annotated[str, typer.Argument(help="Name of the task.")],
    state: Annotated[str, typer.Option("--state", help='The situation, in quotes: "0.1 0.2".')],
    explore: Annotated[bool, typer.Option("--explore", help="Draw a goal to try, rather than the best known.")] = False,
    trial_id: Annotated[
        str | None, typer.Option("--id", metavar="UUID", help="Id of the trial to come; it fixes the draw.")
    ] = None,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Ask which goal to try in a state.

    Example: crkr predict table-tennis --state "0.5 0.1 1.0 -5 0 1.2" --explore
    """
    numbers = parse_vector(state, "--state")
    ids: list[UUID] | None = None if trial_id is None else parse_ids([trial_id])
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        spec = handle.spec
        check_count(numbers, "--state", spec.state)
        answer = handle.predict(numbers, explore, trial_ids=ids)
    if as_json:
        print_json(_data(answer))
    else:
        _show(answer, spec)


def _data(answer: Prediction) -> dict[str, object]:
    names = ("goal", "mean", "sigma", "novelty", "trial_id", "model_version", "active", "policy")
    data = {name: getattr(answer, name) for name in names}
    if answer.predicted_outcome is not None:
        data |= {name: getattr(answer, name) for name in ("predicted_outcome", "predicted_outcome_sd")}
    return data


def _show(answer: Prediction, spec: TaskSpec) -> None:
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
    stdout.print(
        f"novelty {float(answer.novelty):.3f}, policy {answer.policy}, {answer.active} active samples, "
        f"model {answer.model_version}"
    )
    stdout.print(f"trial id {answer.trial_id}")
