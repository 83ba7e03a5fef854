"""What a Ray task does on its node: a supervisor with workers, or one part of a study."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import version
from typing import Any

import ray

from crkr.protocol import CrkrError
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.plan import RunPlan, RunReport
from crkr.sim_worker.supervisor.run import run_workers

__all__ = ["run_place", "work_part"]


def run_place(plan: RunPlan, expected: str) -> RunReport:
    """Runs a plan; a failure that the user can mend becomes the report's problem.

    Args:
        plan: What to do on this node.
        expected: The driver's version of crkr.
    """
    host = ray.util.get_node_ip_address()

    def say(line: str) -> None:
        sys.stderr.write(f"{host}: {line}\n")
        sys.stderr.flush()

    if version("crkr") != expected:
        return _problem(plan, f"node {host} has crkr {version('crkr')}, not {expected}; install that version there")
    try:
        return run_workers(plan, say, lambda _, __: None)
    except CrkrError as error:
        return _problem(plan, f"node {host}: {error}")


def _problem(plan: RunPlan, reason: str) -> RunReport:
    return RunReport(plan.options.name or plan.skill, plan.workers, problem=reason)


@lru_cache(1)
def _skill(name: str, options: SkillOptions) -> Skill:
    return load_skill(name, options)


def work_part(name: str, options: SkillOptions, work: Callable[[Skill, Any], Any], part: Any) -> Any:
    """Does one part, by the skill of this process."""
    return work(_skill(name, options), part)
