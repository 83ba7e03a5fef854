"""Many runs of learning, spread over processes, with progress that people can watch."""

from __future__ import annotations

from collections.abc import Sequence

from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress
from crkr.experiments.learning.run import Course, LearningRun, learn_once
from crkr.sim_worker.guarded_skill import GuardedSkill
from crkr.sim_worker.skill import Skill, SkillOptions
from crkr.sim_worker.supervisor.pool import spread

__all__ = ["learn_many"]


def learn_many(skill: str, options: SkillOptions, parts: Sequence[tuple[Course, int]], jobs: int) -> list[LearningRun]:
    """One run a part, each a course and a seed, in the order of the parts; `jobs` at a time change nothing."""
    runs: dict[int, LearningRun] = {}
    with Progress(stderr, "learning", len(parts), "runs") as progress:
        for place, run in spread(skill, options, _learn, [(place, *part) for place, part in enumerate(parts)], jobs):
            runs[place] = run
            rates = ", ".join(f"{name} {rate:.3f}" for name, rate in run.final.tally.rates().items())
            progress.show(len(runs), f"seed {run.seed}: {rates}", now=True)
    return [runs[place] for place in range(len(parts))]


def _learn(skill: Skill, part: tuple[int, Course, int]) -> tuple[int, LearningRun]:
    place, course, seed = part
    return place, learn_once(GuardedSkill(skill), course, seed)
