"""Everything that a skill needs: what it implements, what it gives and is given. Nothing else knows the task.

A skill is an object with three methods (`Skill`): `spec`, `reset` and `execute`. It may offer more, each for one
purpose: `demonstrations` to start from (`HasDemonstrations`), a `scene` for displays (`HasScene`), a planner for
`crkr oracle` (`HasPlanner`, `HasPlan`) and the options that it chose (`HasOptions`). `restore` makes stored trials
playable again (`HasStates`), `film` gives pictures a finer motion (`HasFilm`), `draw_policy` puts a policy into its
space (`HasPolicyFigure`), and `evaluation_context` chooses what it is judged in (`HasContexts`). examples/reach.py is a
whole one.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from crkr.client.commands.spec_files import read_spec
from crkr.protocol import Array, Geom, Invalid, TaskSpec, Trace, check_name
from crkr.sim_worker.chain import Chain

__all__ = [
    "Chain",
    "Demonstration",
    "Film",
    "Floats",
    "Geom",
    "HasContexts",
    "HasDemonstrations",
    "HasFilm",
    "HasOptions",
    "HasPlan",
    "HasPlanner",
    "HasPolicyFigure",
    "HasScene",
    "HasStates",
    "Invalid",
    "Skill",
    "SkillFactory",
    "SkillOptions",
    "TaskSpec",
    "Trace",
    "TrialResult",
    "judged_state",
    "options_in_force",
    "read_specification",
]

Floats = Array
"""The name of `Array` in skills of users."""


@dataclass(frozen=True, slots=True)
class SkillOptions:
    """How a skill is set up; None leaves the choice to the skill.

    Attributes:
        environment: The simulator that executes trials, e.g. "contact".
        launcher: The distribution of contexts, e.g. "nominal".
        preset: The task specification, e.g. "tuned".
        name: Name of the task; None is the skill's own name.
        seed: Seed of the task's exploration draws.
        traces: Whether results tell the motion; experiments do without, which saves a skill time.
    """

    environment: str | None = None
    launcher: str | None = None
    preset: str | None = None
    name: str | None = None
    seed: int = 0
    traces: bool = True

    def applied_to(self, spec: TaskSpec) -> TaskSpec:
        """A skill's specification with the name and the seed that are asked for."""
        return replace(
            spec, name=spec.name if self.name is None else check_name(self.name), seed=self.seed or spec.seed
        )


@dataclass(frozen=True, slots=True)
class TrialResult:
    """The result of one executed or refused goal.

    Attributes:
        cost: In [0, 1]; None where nothing was executed or measured.
        success: Whether the trial did what is wanted.
        executed: False for a goal that was refused or could not be measured (kind "failed").
        outcome: (q,) signed measurements, NaN where not observed; None where the spec declares none.
        info: Plain data for the log, e.g. {"reason": "miss", "outcomes": {"paper": False, "strict": False}}.
        trace: The motion, for displays; None where nothing moved.
        learn: Whether the regression may learn from it; None: the task's `learn_from` decides.
    """

    cost: float | None
    success: bool
    executed: bool
    outcome: Array | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    trace: Trace | None = None
    learn: bool | None = None

    @property
    def reason(self) -> str:
        """How it ended, in the skill's words."""
        return str(self.info.get("reason", "success" if self.success else "failure"))


@dataclass(frozen=True, slots=True)
class Demonstration:
    """A goal that is known to work.

    Attributes:
        state: (d,) the situation.
        goal: (p,) the meta-parameters.
        result: Of executing the goal; it was executed and succeeded.
    """

    state: Array
    goal: Array
    result: TrialResult


@dataclass(frozen=True, slots=True)
class Film:
    """The motion of one trial, for pictures.

    Attributes:
        trace: Poses and paths.
        moment: The time that matters most, as of a hit or a release [s]; None where none does.
    """

    trace: Trace
    moment: float | None = None


class Skill(Protocol):
    """A task that can be tried: it draws situations and executes goals."""

    def spec(self) -> TaskSpec:
        """The task specification that this skill learns under."""

    def reset(self, rng: np.random.Generator) -> Array:
        """Draws a new situation and returns its state (d,); the next `execute` starts from it."""

    def execute(self, goal: Array) -> TrialResult:
        """Tries a goal (p,) in the situation of the last `reset`; a bad goal gives its reason, no exception.

        An exception, or a result that no trial can hold, counts as a failed trial; ten in a row end the worker.
        """


@runtime_checkable
class HasDemonstrations(Protocol):
    """A skill that can show goals that work."""

    def demonstrations(self, count: int, rng: np.random.Generator, /) -> Sequence[Demonstration]:
        """Demonstrates `count` successful goals for situations drawn from `rng`."""


@runtime_checkable
class HasScene(Protocol):
    """A skill that displays can draw."""

    def scene(self) -> Sequence[Geom]:
        """The shapes that never change; each trial's trace has their poses."""


@runtime_checkable
class HasPlanner(Protocol):
    """A skill that can plan from a model of the task, as a reference for what it learned."""

    def best_plan(self, state: Array, /) -> Mapping[str, bool]:
        """Whether one of its plans for a state (d,) succeeds, by each criterion."""


@runtime_checkable
class HasPlan(Protocol):
    """A skill that can tell such a plan."""

    def plan(self, state: Array, /) -> tuple[Array, TrialResult] | None:
        """A goal (p,) that succeeds in a state (d,), and its result; None where it finds none."""


@runtime_checkable
class HasStates(Protocol):
    """A skill that can be put into any state, as into that of a stored trial."""

    def restore(self, state: Array, /) -> None:
        """Puts the situation of a state (d,); the next `execute` starts from it."""


@runtime_checkable
class HasFilm(Protocol):
    """A skill whose motion can be told more finely than traces have it."""

    def film(self, goal: Array, interval: float, /) -> Film | None:
        """The motion of `execute` in steps of at most `interval` [s]; None where the goal is refused."""


@runtime_checkable
class HasPolicyFigure(Protocol):
    """A skill that draws what goals mean in its space, for `crkr plot policy`."""

    def draw_policy(self, figure: Any, states: Array, goals: Array, index: int, /) -> None:
        """Draws goals (n, p) of states (n, d), which differ in coordinate `index`, into an empty Matplotlib figure."""


@runtime_checkable
class HasContexts(Protocol):
    """A skill that chooses the situations that it is judged in, as a benchmark's fixed ones."""

    def evaluation_context(self, number: int, rng: np.random.Generator, /) -> Array:
        """Puts situation `number` of an evaluation and returns its state (d,); without it, `reset` draws one."""


@runtime_checkable
class HasOptions(Protocol):
    """A skill that tells what it chose where its options left it the choice."""

    @property
    def options(self) -> SkillOptions:
        """The options in force: environment and launcher are named where the skill has any."""


def read_specification(path: Path | str) -> TaskSpec:
    """The specification in a .toml or .json file; raises `Invalid` with the reason and the file's name."""
    return read_spec(Path(path))


def options_in_force(skill: Skill, asked: SkillOptions) -> SkillOptions:
    """The options that a skill made with `asked` runs with; `asked` itself if it does not tell."""
    return skill.options if isinstance(skill, HasOptions) else asked


def judged_state(skill: Skill, number: int, rng: np.random.Generator) -> Array:
    """Puts situation `number` of an evaluation, the skill's own or drawn from `rng`, and returns its state (d,)."""
    return skill.evaluation_context(number, rng) if isinstance(skill, HasContexts) else skill.reset(rng)


class SkillFactory(Protocol):
    """What the entry point group `crkr.skills` names."""

    def __call__(self, options: SkillOptions) -> Skill:
        """Makes the skill; raises `Invalid` for an option it does not know."""


if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """The name that `TrialResult` had before, for one release."""
        if name == "Outcome":
            warnings.warn("crkr.sim_worker.skill.Outcome is now called TrialResult", DeprecationWarning, stacklevel=2)
            return TrialResult
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
