"""What a worker needs of a skill: nothing in server, client or worker knows more about the task than this."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from crkr.protocol import Geom, TaskSpec, Trace

__all__ = [
    "Demonstration",
    "Geom",
    "Outcome",
    "Settled",
    "Skill",
    "SkillFactory",
    "SkillOptions",
    "Trace",
    "options_in_force",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SkillOptions:
    """How a skill is to be set up; None leaves the choice to the skill.

    Attributes:
        environment: Which simulator executes trials, e.g. "contact".
        launcher: Which distribution contexts are drawn from, e.g. "nominal".
        preset: Which task specification to use, e.g. "tuned".
        name: Name of the task; None is the skill's own name.
        seed: Seed of the task's exploration draws.
    """

    environment: str | None = None
    launcher: str | None = None
    preset: str | None = None
    name: str | None = None
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one executed or refused goal.

    Attributes:
        cost: In [0, 1]; None where nothing was executed or measured.
        success: What the skill chose to learn from.
        executed: False for a goal that was refused or not measurable (kind "failed").
        outcome: (q,) signed measurements, NaN where not observed; None where the spec declares none.
        info: Plain data for the log, e.g. {"reason": "miss", "outcomes": {"paper": False, "strict": False}}.
        trace: None where nothing moved.
    """

    cost: float | None
    success: bool
    executed: bool
    outcome: Floats | None
    info: Mapping[str, Any]
    trace: Trace | None


@dataclass(frozen=True, slots=True)
class Demonstration:
    """A goal that is known to work, with what it cost.

    Attributes:
        state: (d,) the situation.
        goal: (p,) the meta-parameters.
        result: What executing the goal gave; it was executed and succeeded.
    """

    state: Floats
    goal: Floats
    result: Outcome


class Skill(Protocol):
    """A task that can be tried: draws situations, executes goals, and knows how to demonstrate."""

    def spec(self) -> TaskSpec:
        """The task specification that this skill learns under."""
        ...

    def reset(self, rng: np.random.Generator) -> Floats:
        """Draws a new situation and returns its state (d,); the next `execute` starts from it."""
        ...

    def execute(self, goal: Floats) -> Outcome:
        """Tries a goal (p,) in the situation of the last `reset`; a bad goal gives its reason, no exception.

        Workers take an exception, or a result that no trial can have, for a failed trial; ten in a row end them.
        """
        ...

    def demonstrations(self, count: int, rng: np.random.Generator) -> Sequence[Demonstration]:
        """Demonstrates `count` successful goals for situations drawn from `rng`."""
        ...

    def scene(self) -> Sequence[Geom]:
        """The shapes that never change, for drawing."""
        ...


@runtime_checkable
class Settled(Protocol):
    """What a skill may offer beside `Skill`: what it chose where its options left it the choice."""

    @property
    def options(self) -> SkillOptions:
        """The options in force: environment and launcher are named where the skill has any."""
        ...


def options_in_force(skill: Skill, asked: SkillOptions) -> SkillOptions:
    """What a skill that was made with `asked` chose; `asked` itself if it does not say."""
    return skill.options if isinstance(skill, Settled) else asked


class SkillFactory(Protocol):
    """What the entry point group `crkr.skills` names."""

    def __call__(self, options: SkillOptions) -> Skill:
        """Makes the skill; raises `crkr.protocol.Invalid` for an option it does not know."""
        ...
