"""A pool of processes, each with its own skill."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TypeVar

from crkr.protocol import CrkrError
from crkr.sim_worker.guarded_skill import keep_standard_output
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.child_process import ctrl_c_blocked, end_with_parent

__all__ = ["ProcessLost", "spread"]

Part = TypeVar("Part")
Result = TypeVar("Result")


class ProcessLost(CrkrError):
    """A process died, and its work is lost."""


def spread(
    skill: str, options: SkillOptions, work: Callable[[Skill, Part], Result], parts: Sequence[Part], jobs: int
) -> Iterator[Result]:
    """Does `work` on every part, `jobs` at a time; yields results as they come.

    Args:
        skill: Name of the skill that each process makes.
        options: How.
        work: A function of a module, with a process's skill and a part.
        parts: Plain data.
        jobs: How many processes.

    Raises:
        ProcessLost: A process died.
        CrkrError: What `work` raises.
    """
    pool = ProcessPoolExecutor(min(jobs, len(parts)), get_context("spawn"), _prepare, (skill, options))
    try:
        with ctrl_c_blocked():  # the processes start at the first submission
            futures: list[Future[Result]] = [pool.submit(_work, work, part) for part in parts]
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise ProcessLost("a process was lost; nothing was stored; try again") from error
    finally:
        pool.shutdown(cancel_futures=True)


_skills: list[Skill] = []  # in a process of the pool: its one skill


def _prepare(name: str, options: SkillOptions) -> None:
    end_with_parent()
    keep_standard_output()
    _skills.append(load_skill(name, options))


def _work(work: Callable[[Skill, Part], Result], part: Part) -> Result:
    return work(_skills[0], part)
