"""Workers and runs as tasks of a Ray cluster, which starts them on its nodes and restarts those of a dead node."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, TypeVar, final

import ray
from ray import cloudpickle
from ray.exceptions import RayError, TaskCancelledError

from crkr.client import Client, Task
from crkr.client.cli.stop_request import StopRequest
from crkr.protocol import CrkrError, Invalid
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.randomness import place_seed
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skill_registry import installed_skills, load_skill
from crkr.sim_worker.supervisor.plan import RunPlan, RunReport
from crkr.sim_worker.supervisor.supervisor import training_trials

__all__ = ["RayCluster", "part_plans"]

POLL_S: Final = 0.5
STOP_WITHIN_S: Final = 10.0  # for an unreachable node; Ray notices after a minute
RETRIES: Final = 3  # of a part, in case its skill ends the process each time
STATUS_TIMEOUT_S: Final = 1.0
CONNECT_WITHIN_S: Final = 5.0

Part = TypeVar("Part")
Result = TypeVar("Result")


def part_plans(plan: RunPlan, per_place: int) -> list[RunPlan]:
    """A plan for each place, with at most `per_place` workers and its own seed."""
    counts = [min(per_place, plan.workers - start) for start in range(0, plan.workers, per_place)]
    return [replace(plan, workers=count, seed=place_seed(plan.seed, index)) for index, count in enumerate(counts)]


@final
class RayCluster:
    """The cluster that `RAY_ADDRESS` names, or the one that this machine belongs to.

    Every node needs this version of crkr, and the skill's libraries. A user's skill is copied to the nodes: the folder
    of its file, or the working directory for a skill named by its module.
    """

    def run(
        self, plan: RunPlan, per_place: int, say: Callable[[str], None], show: Callable[[int, str], None]
    ) -> RunReport:
        """Trains with a supervisor at each place, all towards the plan's total; see `Places.run`."""
        task = GuardedSkill(load_skill(plan.skill, plan.options)).spec().name
        with (
            _connected(plan.skill) as skill,
            Client(plan.endpoint, zenoh_config=plan.zenoh_config) as client,
            StopRequest() as stop,
        ):
            plans = part_plans(replace(plan, skill=skill), per_place)
            _check_reach(plan.endpoint)
            _tell_shortage(plan.workers, say)
            work = ray.remote(max_retries=-1, scheduling_strategy="SPREAD")(_node_function("run_place"))
            waiting = [
                work.options(num_cpus=one.workers).remote(cloudpickle.dumps((one, version("crkr")))) for one in plans
            ]
            progress = _Progress(client.task(task), show)
            reports: list[RunReport] = []
            try:
                while waiting and not stop:
                    ready, waiting = ray.wait(waiting, timeout=POLL_S)
                    for report in [_report(ref, task) for ref in ready]:
                        reports.append(report)
                        if report.problem is not None:
                            say(f"warning: {report.problem}")
                    progress.update(len(waiting))
            finally:
                reports += _cancel(waiting, task, say)
            progress.update(0)
        report = RunReport.merged(task, plan.workers, reports)
        report.trained = max(report.trained, progress.trained)
        report.stopped_by = stop.signal
        return report

    def spread(
        self, skill: str, options: SkillOptions, work: Callable[[Skill, Part], Result], parts: Sequence[Part], jobs: int
    ) -> Iterator[Result]:
        """Does `work` on every part, as many at a time as the cluster has processors; see `Places.spread`."""
        del jobs  # Unused.
        with _connected(skill) as name:
            work_part = _node_function("work_part")
            call = ray.remote(max_retries=RETRIES, num_cpus=1, scheduling_strategy="SPREAD")(work_part)
            waiting = [call.remote(cloudpickle.dumps((name, options, work, part))) for part in parts]
            try:
                while waiting:
                    ready, waiting = ray.wait(waiting, timeout=POLL_S)
                    for ref in ready:
                        yield _value(ref)
            finally:
                for ref in waiting:
                    ray.cancel(ref, force=True)


@contextmanager
def _connected(skill: str) -> Iterator[str]:
    """A connection to the cluster; gives the skill's name on its nodes."""
    name, folder = _travelling(skill)
    address = os.environ.get("RAY_ADDRESS", "auto")
    os.environ.setdefault("RAY_DEDUP_LOGS", "0")  # each place's lines are its own
    try:
        _check_connection(address)
        ray.init(
            address=address,
            logging_level=logging.ERROR,
            runtime_env={} if folder is None else {"working_dir": str(folder)},
        )
    except (OSError, RayError, RuntimeError, ValueError) as error:
        raise CrkrError(
            f"no Ray cluster at {address!r} ({_last_line(error)}); start one with `ray start --head`, or name one "
            "with RAY_ADDRESS=host:6379"
        ) from error
    try:
        yield name
    finally:
        ray.shutdown()


def _check_connection(address: str) -> None:
    """Raises `OSError` where nothing listens; Ray itself would end this process."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit() and "//" not in host:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_WITHIN_S).close()


def _travelling(skill: str) -> tuple[str, Path | None]:
    """A skill's name on the nodes, and the folder to copy there; None for an installed one."""
    if skill in installed_skills() or ":" not in skill:
        return skill, None
    where, _, factory = skill.rpartition(":")
    if os.sep in where or where.endswith(".py"):
        file = Path(where).absolute()
        return f"{file.name if file.suffix == '.py' else f'{file.name}.py'}:{factory}", file.parent
    local = Path.cwd() / where.split(".")[0]
    return skill, Path.cwd() if local.is_dir() or local.with_suffix(".py").is_file() else None


def _check_reach(endpoint: str) -> None:
    """Refuses an address of this machine alone where there are other machines."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    nodes = [node for node in ray.nodes() if node["Alive"]]
    if len({node["NodeManagerAddress"] for node in nodes}) > 1 and (host in ("localhost", "::1") or host[:4] == "127."):
        raise Invalid(
            f"{endpoint} is an address of each machine itself, and the cluster has {len(nodes)} nodes; "
            "let the server listen on an address that they reach, and name it with --connect"
        )


def _tell_shortage(wanted: int, say: Callable[[str], None]) -> None:
    processors = int(ray.cluster_resources().get("CPU", 0))
    if processors < wanted:
        say(f"the cluster has {processors} processors for {wanted} workers; the rest start when some are free or added")


@final
@dataclass(slots=True)
class _Progress:
    """The training trials that the server holds, shown while places work."""

    task: Task
    show: Callable[[int, str], None]
    trained: int = 0

    def update(self, places: int) -> None:
        with suppress(CrkrError):  # not created yet, or away; the places are more patient and report it
            self.trained = training_trials(self.task.status(timeout_s=STATUS_TIMEOUT_S))
        self.show(self.trained, f"{places} places at work")


def _node_function(name: str) -> Callable[[bytes], Any]:
    """A function of `ray_node`, called with arguments that are unpacked on the node.

    Ray copies the inner function as code, so that it can report a missing crkr.
    """

    def call(arguments: bytes) -> Any:
        from importlib import import_module

        from ray import cloudpickle

        try:
            module = import_module("crkr.sim_worker.places.ray_node")
        except ModuleNotFoundError as error:
            return ModuleNotFoundError(f"No module named {error.name!r}", name=error.name)
        return getattr(module, name)(*cloudpickle.loads(arguments))

    return call


def _value(ref: Any) -> Any:
    """A finished task's result; raises its exception, or `CrkrError` if Ray or a node failed."""
    try:
        value = ray.get(ref)
    except TaskCancelledError:
        raise
    except RayError as error:
        cause = getattr(error, "cause", None)
        if isinstance(cause, CrkrError):
            raise cause from error
        raise CrkrError(f"a task of the cluster failed: {_last_line(error)}") from error
    if isinstance(value, ModuleNotFoundError):
        raise CrkrError(
            f"a node of the cluster lacks the module {value.name}; install crkr[sim]=={version('crkr')} on every node"
        )
    return value


def _last_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _report(ref: Any, task: str) -> RunReport:
    try:
        report: RunReport = _value(ref)
    except TaskCancelledError:
        return RunReport(task, 0)
    except CrkrError as error:
        return RunReport(task, 0, problem=str(error))
    return report


def _cancel(waiting: list[Any], task: str, say: Callable[[str], None]) -> list[RunReport]:
    """Interrupts places and returns their reports; gives up those that do not end in time."""
    for ref in waiting:
        ray.cancel(ref)
    deadline, reports = time.monotonic() + STOP_WITHIN_S, list[RunReport]()
    while waiting and time.monotonic() < deadline:
        ready, waiting = ray.wait(waiting, timeout=POLL_S)
        reports += [_report(ref, task) for ref in ready]
    for ref in waiting:
        ray.cancel(ref, force=True)
    if waiting:
        say(f"warning: {len(waiting)} places did not end within {STOP_WITHIN_S:g} s; what they stored is kept")
    return reports
