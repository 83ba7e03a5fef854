"""`crkr explain`."""

from __future__ import annotations

from typing import Annotated

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table, stdout
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig, check_count, parse_ids, parse_vector
from crkr.protocol import SampleExplanation

__all__ = ["explain"]


def explain(
    task: Annotated[str, typer.Argument(help="Name of the task.")],
    state: Annotated[str, typer.Option("--state", help='The situation, in quotes: "0.1 0.2".')],
    sample: Annotated[str | None, typer.Option("--sample", metavar="UUID", help="Where does this one stand?")] = None,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Show the samples behind an answer, and why one sample is or is not in the model.

    Example: crkr explain throw --state "0.3 1.2"
    """
    numbers = parse_vector(state, "--state")
    sample_id = None if sample is None else parse_ids([sample])[0]
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        check_count(numbers, "--state", handle.spec.state)
        answer = handle.explain(numbers, sample_id)
    if as_json:
        print_json(answer)
        return
    print_table(
        ("sample", "weight", "cost", "distance"),
        [(n.id, f"{n.weight:+.4f}", f"{n.cost:.4f}", f"{n.distance:.3f}") for n in answer.neighbours],
    )
    stdout.print(f"novelty {answer.novelty:.3f}; distances in length-scales")
    if answer.sample is not None:
        stdout.print(_sentence(answer.sample))


def _sentence(sample: SampleExplanation) -> str:
    if not sample.eligible:
        return f"{sample.id} is not learned from"
    place = "is in the model" if sample.active else "is not in the model"
    if sample.suppressor is None:
        return f"{sample.id} {place}; no sample near it is better"
    radius = "" if sample.radius is None else f", {sample.radius:.3f} length-scales away"
    return f"{sample.id} {place}; the nearest better sample is {sample.suppressor}{radius}"
