"""`crkr report`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated
from uuid import uuid4

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, stdout
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig, check_count, parse_ids, parse_vector

__all__ = ["report"]


def report(
    task: Annotated[str, typer.Argument(help="Name of the task.")],
    state: Annotated[str, typer.Option("--state", help='The situation, in quotes: "0.1 0.2".')],
    goal: Annotated[str, typer.Option("--goal", help="The goal that was executed, in quotes.")],
    success: Annotated[bool, typer.Option("--success/--failure", help="May it be learned from?")],
    cost: Annotated[float | None, typer.Option("--cost", help="In [0, 1]; left out only for kind failed.")] = None,
    kind: Annotated[str, typer.Option("--kind", help="trial, demonstration, evaluation or failed.")] = "trial",
    outcome: Annotated[str | None, typer.Option("--outcome", help="Measured numbers; nan is not observed.")] = None,
    trial_id: Annotated[
        str | None, typer.Option("--id", metavar="UUID", help="The trial's id, as `crkr predict` gave it.")
    ] = None,
    worker: Annotated[str | None, typer.Option("--worker", help="Who reports.")] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Return only when the model includes it.")] = False,
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    as_json: Json = False,
) -> None:
    """Store what a goal cost; it is on the server's disk when this returns.

    Example: crkr report throw --state "0.3 1.2" --goal "3.4 0.25" --cost 0.12 --success
    """
    numbers, aim = parse_vector(state, "--state"), parse_vector(goal, "--goal")
    measured = None if outcome is None else parse_vector(outcome, "--outcome")
    identifier = uuid4() if trial_id is None else parse_ids([trial_id])[0]
    with Client(connect, timeout_s=timeout, zenoh_config=zenoh_config) as client:
        handle = client.task(task)
        check_count(numbers, "--state", handle.spec.state)
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
            wait=wait,
        )
    if as_json:
        print_json({**asdict(receipt), "ids": [identifier]})
    else:
        what = "stored" if receipt.accepted else "known already"
        stdout.print(f"{what}: number {receipt.seqs[0]}; the model is at {receipt.model_version}")
        stdout.print(f"trial id {identifier}")
