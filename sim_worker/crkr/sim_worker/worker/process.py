"""The body of a worker process: its settings, its loop and its end."""

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
from crkr.sim_worker.guarded_skill import GuardedSkill, keep_standard_output, one_line
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.child_process import MessagePipe, PipeClosed, end_with_parent
from crkr.sim_worker.worker.supervisor_link import Stopped, SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry
from crkr.sim_worker.worker.trial_loop import Identity, TrialLoop

__all__ = ["ProcessSettings", "run_worker"]

logger = logging.getLogger(__name__)

FAILED: Final = 1
FINISH_S: Final = 1.2
"""Time for a stopped worker to complete its evaluations [s]."""


@final
@dataclass(frozen=True, slots=True)
class ProcessSettings:
    """Settings of a worker process; plain data, because they cross to another process.

    Attributes:
        skill: Name of the skill.
        options: How to make it.
        task: Name of the task, which exists.
        endpoint: The server's.
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
    """Follows the supervisor's orders until it is stopped; reports the reason of any other end."""
    end_with_parent()
    keep_standard_output()
    configure_logging(settings.log_level)
    link = SupervisorLink(MessagePipe(connection), settings.patience_s)
    try:
        skill = GuardedSkill(load_skill(settings.skill, settings.options))
        with Client(settings.endpoint, timeout_s=settings.timeout_s, zenoh_config=settings.zenoh_config) as client:
            task = client.task(settings.task)
            with link.retry_while_away(lambda: task.announce(settings.identity.worker)):
                _work(settings, task, skill, link)
    except Stopped:
        return
    except PipeClosed:
        logger.info("the supervisor is gone")
    except CrkrError as error:
        _explain(link, error.message)
        sys.exit(FAILED)
    except KeyboardInterrupt as error:  # of the skill: a terminal's is blocked
        _explain(link, one_line(error))
        sys.exit(FAILED)
    except Exception as error:
        _explain(link, f"{type(error).__name__}: {error}")
        raise


def _work(settings: ProcessSettings, task: Task, skill: GuardedSkill, link: SupervisorLink) -> None:
    """Runs a trial per ticket, and between two trials one context of an evaluation."""
    telemetry, identity = Telemetry(task, skill.scene()), settings.identity
    loop = TrialLoop(task, skill, identity, link, telemetry, wait=settings.wait)
    evaluator = Evaluator(task, skill, settings.evaluations, identity.worker, link, telemetry)
    link.send("ready")
    try:
        while True:
            if link.has_order() or not evaluator.busy:
                match link.next_order():
                    case {"order": "judge", "epoch": epoch, "trained": trained}:
                        evaluator.judge(epoch, trained)
                    case {"order": "go"}:
                        trial = loop.run_one()
                        link.send("done", success=trial.success)
            evaluator.play_next()
    except Stopped:
        evaluator.finish(FINISH_S)
        raise


def _explain(link: SupervisorLink, reason: str) -> None:
    try:
        link.send("failed", reason=reason)
    except PipeClosed:
        logger.warning("%s; and the supervisor is gone", reason)
