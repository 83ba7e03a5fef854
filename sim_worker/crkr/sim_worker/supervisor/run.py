"""One run of `crkr workers`, from its plan to its report: skill, server, task, demonstrations, processes."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Callable
from dataclasses import replace

from crkr.client import Client, Task
from crkr.protocol import NoSamples, Unavailable
from crkr.sim_worker.evaluation.epoch_schedule import JudgeRole
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import demonstration_rng, worker_seed
from crkr.sim_worker.skill_registry import load_skill, portable_name
from crkr.sim_worker.supervisor.plan import RunPlan, RunReport
from crkr.sim_worker.supervisor.supervisor import Supervisor, training_trials
from crkr.sim_worker.supervisor.task_setup import create_or_join, delete_if_there, record_demonstrations
from crkr.sim_worker.worker.process import ProcessSettings
from crkr.sim_worker.worker.trial_loop import Identity

__all__ = ["run_workers"]

QUICK_S = 1.0


def run_workers(plan: RunPlan, say: Callable[[str], None], show: Callable[[int, str], None]) -> RunReport:
    """Runs a plan.

    Raises:
        CrkrError: There is no such skill, the server is away for longer than the patience, or the task differs.
    """
    skill = GuardedSkill(load_skill(plan.skill, plan.options))
    with Client(plan.endpoint, timeout_s=plan.timeout_s, zenoh_config=plan.zenoh_config) as client:
        _wait_for_server(client, plan.patience_s, say)
        spec = replace(skill.spec(), skill=portable_name(plan.skill))
        if plan.fresh:
            delete_if_there(client, spec.name, say)
        task = create_or_join(client, spec, say, its_settings=plan.options.preset is None)
        for line in skill.lacks:
            say(f"skill {plan.skill} has {line}")
        added = _demonstrate(plan, task, skill, say)
        status = task.status()
        trained, identity = training_trials(status), Identity(_name(), plan.seed, int(status["seq"]))
        asked = "" if plan.total is None else f", {plan.total} asked for"
        say(f"task {task.name} holds {trained} training trials{asked}")
        supervisor = Supervisor(
            plan,
            task,
            _settings(plan, task, identity),
            [worker_seed(plan.seed, index) for index in range(plan.workers)],
            trained,
            JudgeRole(client, task, say) if plan.evaluations else None,
            say,
            show,
        )
        report = supervisor.run()
    report.demonstrations = added
    return report


def _wait_for_server(client: Client, patience_s: float, say: Callable[[str], None]) -> None:
    try:
        client.wait_until_ready(min(QUICK_S, patience_s))
    except Unavailable:
        say(f"waiting up to {patience_s:g} s for a server at {client.endpoint}")
        client.wait_until_ready(patience_s)


def _demonstrate(plan: RunPlan, task: Task, skill: GuardedSkill, say: Callable[[str], None]) -> int:
    """Records missing demonstrations; without any, the server chooses the first goals."""
    if not skill.can_demonstrate:
        return 0
    worker = f"{_name()}-demo"
    with task.announce(worker):  # listed among the workers while it demonstrates
        added = record_demonstrations(task, skill, plan.demonstrations, demonstration_rng(plan.seed), worker)
    if added:
        say(f"recorded {added} demonstrations")
    if task.spec.start.type == "demonstrations" and not task.status()["active"]:
        raise NoSamples(f"task {task.name!r} has nothing to start from; let --demonstrations be more than 0")
    return added


def _settings(plan: RunPlan, task: Task, identity: Identity) -> ProcessSettings:
    return ProcessSettings(
        skill=plan.skill,
        options=plan.options,
        task=task.name,
        endpoint=plan.endpoint,
        zenoh_config=plan.zenoh_config,
        timeout_s=plan.timeout_s,
        patience_s=plan.patience_s,
        identity=identity,
        evaluations=plan.evaluations,
        wait=plan.wait,
        log_level=plan.log_level,
    )


def _name() -> str:
    """This supervisor's name in worker ids: unique among machines, containers and supervisors."""
    host = re.sub(r"[^a-z0-9]+", "-", socket.gethostname().lower()).strip("-")[:32] or "host"
    return f"{host}-{os.getpid()}"
