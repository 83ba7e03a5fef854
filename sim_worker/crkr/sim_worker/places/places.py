"""Places that execute workers and runs, by name: `here`, or an entry point of the group `crkr.places`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import entry_points
from typing import Final, Protocol, TypeVar, final

from crkr.protocol import Invalid
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.supervisor.plan import RunPlan, RunReport
from crkr.sim_worker.supervisor.pool import spread
from crkr.sim_worker.supervisor.run import run_workers

__all__ = ["GROUP", "Here", "Places", "load_places"]

GROUP: Final = "crkr.places"

Part = TypeVar("Part")
Result = TypeVar("Result")


class Places(Protocol):
    """Executes plans and parts, on one machine or many; both methods block until all is done."""

    def run(
        self, plan: RunPlan, per_place: int, say: Callable[[str], None], show: Callable[[int, str], None]
    ) -> RunReport:
        """Trains as `run_workers` does.

        Args:
            plan: The plan for all workers.
            per_place: Workers that share a supervisor and a machine, where there are several machines.
            say: Prints a line for people.
            show: Shows the training trials stored and a remark, often.

        Raises:
            CrkrError: The server or the cluster cannot be reached, or the task differs.
        """

    def spread(
        self, skill: str, options: SkillOptions, work: Callable[[Skill, Part], Result], parts: Sequence[Part], jobs: int
    ) -> Iterator[Result]:
        """Does `work` on every part as `supervisor.pool.spread` does; a cluster runs as many as it has processors."""


@final
class Here:
    """Processes of this machine: one supervisor with all workers."""

    def run(
        self, plan: RunPlan, per_place: int, say: Callable[[str], None], show: Callable[[int, str], None]
    ) -> RunReport:
        """Runs the whole plan at one place."""
        del per_place  # Unused.
        return run_workers(plan, say, show)

    def spread(
        self, skill: str, options: SkillOptions, work: Callable[[Skill, Part], Result], parts: Sequence[Part], jobs: int
    ) -> Iterator[Result]:
        """Spreads the parts over `jobs` processes."""
        return spread(skill, options, work, parts, jobs)


def load_places(name: str) -> Places:
    """Loads places by name.

    Raises:
        Invalid: No package offers that name.
        ModuleNotFoundError: The library that they need is not installed.
    """
    offered = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in offered:
        raise Invalid(f"no places {name!r} to run on; there are: {', '.join(sorted(offered))}")
    places: Places = offered[name].load()()
    return places
