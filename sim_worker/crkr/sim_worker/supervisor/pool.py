"""A pool of processes, each with its own skill."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from multiprocessing.process import BaseProcess
from typing import Final, TypeVar

from crkr.protocol import CrkrError
from crkr.sim_worker.guarded_skill import keep_standard_output
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.skill_registry import load_skill
from crkr.sim_worker.supervisor.child_process import ctrl_c_blocked, descendants_ended, end_with_parent

__all__ = ["ProcessLost", "spread"]

LOOKS_S: Final = 0.5
ENDS_S: Final = 2.0

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
    others, processes, patience_s = set(active_children()), set[BaseProcess](), 0.0
    pool = ProcessPoolExecutor(min(jobs, len(parts)), get_context("spawn"), _prepare, (skill, options))
    ending = threading.Thread(target=pool.shutdown, kwargs={"cancel_futures": True}, daemon=True)
    try:
        with descendants_ended():
            try:
                with ctrl_c_blocked():  # the processes start at the submissions
                    waiting: set[Future[Result]] = {pool.submit(_work, work, part) for part in parts}
                processes = set(active_children()) - others
                while waiting:
                    done, waiting = wait(waiting, LOOKS_S, FIRST_COMPLETED)
                    for future in sorted(done, key=lambda each: each.exception() is not None):  # results first
                        yield future.result()
                    if any(process.exitcode is not None for process in processes):  # also if a child holds its pipes
                        raise BrokenProcessPool
                patience_s = ENDS_S
            except BrokenProcessPool as error:
                raise ProcessLost("a process was lost; nothing was stored; try again") from error
            finally:
                ending.start()
                ending.join(patience_s)
                for process in processes:  # a skill may never return, or leave a thread behind
                    process.kill()
    finally:
        ending.join(ENDS_S)


_skills: list[Skill] = []  # in a process of the pool: its one skill


def _prepare(name: str, options: SkillOptions) -> None:
    end_with_parent()
    keep_standard_output()
    _skills.append(load_skill(name, options))


def _work(work: Callable[[Skill, Part], Result], part: Part) -> Result:
    return work(_skills[0], part)
