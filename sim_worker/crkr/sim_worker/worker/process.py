"""What runs inside a worker's process."""

from __future__ import annotations

import logging
import sys
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, final

from crkr.client import Client, Task
from crkr.client.cli.console import configure_logging
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluation.evaluator import Evaluator
from crkr.sim_worker.guarded_skill import GuardedSkill, keep_standard_output
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.parent_watch import end_with_parent
from crkr.sim_worker.supervisor.pipe import Line, LineClosed
from crkr.sim_worker.worker.supervisor_link import Orders, Stopped
from crkr.sim_worker.worker.telemetry import Telemetry
from crkr.sim_worker.worker.trial_loop import Identity, TrialLoop

__all__ = ["ProcessSettings", "run_worker"]

logger = logging.getLogger(__name__)

FAILED: Final = 1
FINISH_S: Final = 1.2
"""When told to stop, a worker may complete its evaluations for this long [s]."""


@final
@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """What a worker's process needs to know; plain data, because it crosses to another process.

    Attributes:
        skill: Name of the skill.
        options: How to make it.
        task: Name of the task, which exists.
        endpoint: Where the server is.
        zenoh_config: Transport settings, or None.
        timeout_s: Deadline of a call [s].
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
    timeout_s: float
    patience_s: float
    identity: Identity
    evaluations: int
    wait: bool
    log_level: str


def run_worker(settings: ProcessSettings, connection: Connection) -> None:
    """Body of a worker process: serves its line until it is told to stop, and sees that the launcher learns its end."""
    end_with_parent()
    keep_standard_output()
    configure_logging(settings.log_level)
    orders = Orders(Line(connection), settings.patience_s)
    try:
        skill = GuardedSkill(load_skill(settings.skill, settings.options))
        with Client(settings.endpoint, timeout_s=settings.timeout_s, zenoh_config=settings.zenoh_config) as client:
            task = client.task(settings.task)
            with orders.insist(lambda: task.announce(settings.identity.worker)):
                _work(settings, task, skill, orders)
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


def _work(settings: ProcessSettings, task: Task, skill: Skill, orders: Orders) -> None:
    """A trial for every ticket, and between two trials one context of an evaluation, if there is any."""
    telemetry, identity = Telemetry(task, skill.scene()), settings.identity
    loop = TrialLoop(task, skill, identity, orders, telemetry, wait=settings.wait)
    evaluator = Evaluator(task, skill, settings.evaluations, identity.worker, orders, telemetry)
    orders.tell("ready")
    try:
        while True:
            if orders.waiting() or not evaluator.busy:
                match orders.next():
                    case {"order": "judge", "epoch": epoch, "trained": trained}:
                        evaluator.judge(epoch, trained)
                    case {"order": "go"}:
                        trial = loop.run_one()
                        orders.tell("done", success=trial.success)
            evaluator.play_next()
    except Stopped:
        evaluator.finish(FINISH_S)
        raise


def _explain(orders: Orders, reason: str) -> None:
    try:
        orders.tell("failed", reason=reason)
    except LineClosed:
        logger.warning("%s; and the launcher is gone", reason)
