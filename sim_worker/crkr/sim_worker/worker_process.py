"""What runs inside a worker's and the evaluator's process."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, final

from crkr.client import Client, Task
from crkr.client.console import configure_logging
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluator import Evaluator
from crkr.sim_worker.line import Line, LineClosed
from crkr.sim_worker.orders import Orders, Stopped
from crkr.sim_worker.parent import end_with_parent
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skills import load_skill
from crkr.sim_worker.trial_loop import Identity, TrialLoop

__all__ = ["ProcessSettings", "run_evaluator", "run_worker"]

logger = logging.getLogger(__name__)

FAILED: Final = 1


@final
@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """What a worker or evaluator process needs to know; plain data, because it crosses to another process.

    Attributes:
        skill: Name of the skill.
        options: How to make it.
        task: Name of the task, which exists.
        endpoint: Where the server is.
        zenoh_config: Transport settings, or None.
        patience_s: How long the server may be away [s].
        identity: Names and seeds.
        evaluations: Contexts of an epoch's evaluation.
        wait: Reports return when the model includes the trial.
        log_level: For this process's log.
    """

    skill: str
    options: SkillOptions
    task: str
    endpoint: str
    zenoh_config: Path | None
    patience_s: float
    identity: Identity
    evaluations: int
    wait: bool
    log_level: str


def run_worker(settings: ProcessSettings, connection: Connection) -> None:
    """Body of a worker process: a trial for every ticket."""

    def work(task: Task, skill: Skill, orders: Orders) -> None:
        loop = TrialLoop(task, skill, settings.identity, orders, wait=settings.wait)
        orders.tell("ready")
        while True:
            orders.next()  # a ticket
            trial = loop.run_one()
            orders.tell("done", kind=trial.kind, success=trial.success)

    _serve(settings, connection, work)


def run_evaluator(settings: ProcessSettings, connection: Connection) -> None:
    """Body of the evaluator process."""

    def work(task: Task, skill: Skill, orders: Orders) -> None:
        evaluator = Evaluator(task, skill, settings.evaluations, settings.identity.worker, orders)
        orders.tell("ready")
        evaluator.run()

    _serve(settings, connection, work)


def _serve(settings: ProcessSettings, connection: Connection, work: Callable[[Task, Skill, Orders], None]) -> None:
    """Sets up a process, runs its work until it is told to stop, and sees that the launcher learns why it ended."""
    end_with_parent()
    configure_logging(settings.log_level)
    orders = Orders(Line(connection), settings.patience_s)
    try:
        skill = load_skill(settings.skill, settings.options)
        with Client(settings.endpoint, zenoh_config=settings.zenoh_config) as client:
            task = orders.insist(lambda: client.task(settings.task))
            with task.announce(settings.identity.worker):
                work(task, skill, orders)
    except Stopped:
        return
    except LineClosed:
        logger.info("the launcher is gone")
    except CrkrError as error:
        _explain(orders, error.message)
        sys.exit(FAILED)
    except Exception as error:
        _explain(orders, f"{type(error).__name__}: {error}")
        raise


def _explain(orders: Orders, reason: str) -> None:
    try:
        orders.tell("failed", reason=reason)
    except LineClosed:
        logger.warning("%s; and the launcher is gone", reason)
