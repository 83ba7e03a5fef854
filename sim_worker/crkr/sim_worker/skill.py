"""The interfaces and values of a skill. No other part knows the task.

A skill is an object with three methods (`Skill`): `spec`, `reset` and `execute`. Optional are `demonstrations` to start
from (`HasDemonstrations`), a `scene` for displays (`HasScene`), a planner for `crkr oracle` (`HasPlanner`, `HasPlan`),
the chosen `options` (`HasOptions`), `restore` to replay stored trials (`HasStates`), `film` for finer motion in
pictures (`HasFilm`), `draw_policy` for a figure of a policy (`HasPolicyFigure`), and `evaluation_context` for its own
evaluation contexts (`HasContexts`). examples/reach.py is a complete skill.
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
        traces: Whether results have traces; without them, experiments save time.
    """

    environment: str | None = None
    launcher: str | None = None
    preset: str | None = None
    name: str | None = None
    seed: int = 0
    traces: bool = True

    def applied_to(self, spec: TaskSpec) -> TaskSpec:
        """A skill's specification with the requested name and seed."""
        return replace(
            spec, name=spec.name if self.name is None else check_name(self.name), seed=self.seed or spec.seed
        )


@dataclass(frozen=True, slots=True)
class TrialResult:
    """The result of one executed or refused goal.

    Attributes:
        cost: In [0, 1]; None where nothing was executed or measured.
        success: Whether the trial succeeded.
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
        moment: The most important time, as of a hit or a release [s]; None without one.
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
        """Tries a goal (p,) in the situation of the last `reset`; a bad goal gives a reason, not an exception.

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
    """A skill with a planner that knows the task's model, as a reference for the learned policy."""

    def best_plan(self, state: Array, /) -> Mapping[str, bool]:
        """Whether one of its plans for a state (d,) succeeds, by each criterion."""


@runtime_checkable
class HasPlan(Protocol):
    """A skill that can return such a plan."""

    def plan(self, state: Array, /) -> tuple[Array, TrialResult] | None:
        """A goal (p,) that succeeds in a state (d,), and its result; None if it finds none."""


@runtime_checkable
class HasStates(Protocol):
    """A skill that can set up any state, e.g. that of a stored trial."""

    def restore(self, state: Array, /) -> None:
        """Sets up the situation of a state (d,); the next `execute` starts from it."""


@runtime_checkable
class HasFilm(Protocol):
    """A skill that can return a motion finer than its traces."""

    def film(self, goal: Array, interval: float, /) -> Film | None:
        """The motion of `execute` in steps of at most `interval` [s]; None where the goal is refused."""


@runtime_checkable
class HasPolicyFigure(Protocol):
    """A skill that draws goals in its workspace, for `crkr plot policy`."""

    def draw_policy(self, figure: Any, states: Array, goals: Array, index: int, /) -> None:
        """Draws goals (n, p) of states (n, d), which differ in coordinate `index`, into an empty Matplotlib figure."""


@runtime_checkable
class HasContexts(Protocol):
    """A skill with its own evaluation situations, such as a benchmark's fixed ones."""

    def evaluation_context(self, number: int, rng: np.random.Generator, /) -> Array:
        """Sets up situation `number` of an evaluation and returns its state (d,); without it, `reset` draws one."""


@runtime_checkable
class HasOptions(Protocol):
    """A skill that reports the options in force."""

    @property
    def options(self) -> SkillOptions:
        """The options in force, with the chosen environment and launcher, if the skill has any."""


def read_specification(path: Path | str) -> TaskSpec:
    """The specification in a .toml or .json file; raises `Invalid` with the reason and the file's name."""
    return read_spec(Path(path))


def options_in_force(skill: Skill, asked: SkillOptions) -> SkillOptions:
    """The options in force of a skill made with `asked`; `asked` itself if it does not report them."""
    return skill.options if isinstance(skill, HasOptions) else asked


def judged_state(skill: Skill, number: int, rng: np.random.Generator) -> Array:
    """Sets up situation `number` of an evaluation, the skill's own or drawn from `rng`; returns its state (d,)."""
    return skill.evaluation_context(number, rng) if isinstance(skill, HasContexts) else skill.reset(rng)


class SkillFactory(Protocol):
    """The type of entry points in the group `crkr.skills`."""

    def __call__(self, options: SkillOptions) -> Skill:
        """Makes the skill; raises `Invalid` for an option it does not know."""


if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        """The old name of `TrialResult`, for one release."""
        if name == "Outcome":
            warnings.warn("crkr.sim_worker.skill.Outcome is now called TrialResult", DeprecationWarning, stacklevel=2)
            return TrialResult
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
