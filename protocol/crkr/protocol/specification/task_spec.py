"""A task's specification: its axes and how it learns. Frozen, and checked once when it is read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, final

import numpy as np

from crkr.protocol.checks import choice, integer, number, required, text
from crkr.protocol.codec import Array
from crkr.protocol.errors import Invalid
from crkr.protocol.keys import check_name
from crkr.protocol.specification.dimensions import GoalDimension, OutcomeEntry, StateDimension
from crkr.protocol.specification.settings import EARLIER_EXPLORATION, LARGEST, Exploration, KernelSettings, Start

__all__ = ["CHANGEABLE", "TaskSpec"]

CHANGEABLE: Final = (
    "regularisation",
    "budget",
    "cost_map",
    "noise_floor",
    "explore_scale",
    "exploration_floor",
    "learn_from",
    "novel",
    "novelty_limit",
    "refit_every",
    "kernel",
    "skill",
)
_APART: Final = ("description", "skill")  # for people and commands; two specifications may differ in them
MAX_DIMENSIONS: Final = 256


@final
@dataclass(frozen=True, slots=True)
class TaskSpec:
    """What a task maps (R^d to R^p) and how.

    Attributes:
        name: Name in keys, [a-z0-9][a-z0-9-]{0,62}.
        state: d dimensions of the situation.
        goal: p meta-parameters.
        description: For people.
        seed: Seed of the exploration draws.
        outcome: q numbers measured after a trial; may be empty.
        exploration: How goals are drawn when exploring.
        kernel: Covariance of the scaled goals.
        budget: k, the largest number of active samples; see `limits` for what new tasks may ask for.
        regularisation: lambda, the exploration-exploitation trade-off.
        cost_map: g, from cost to relative noise: "linear" g(c) = c, "odds" g(c) = c / (1 - c).
        noise_floor: Smallest noise, relative to the signal variance.
        learn_from: "successes" or "all" executed trials.
        prior_mean: "zero" or "demonstrations" (their mean goal).
        explore_scale: Multiplies sigma.
        exploration_floor: Added to sigma^2 in scaled units.
        novel: "predict" or "refuse" states above the limit.
        novelty_limit: In [0, 1].
        selector: Which samples are active: "anms", "full" or "freeze".
        refit_every: Eligible samples between evidence fits; 0: only on request.
        start: Exploration before the first success.
        cost: "measured" in every executed trial; or "label": a trial may omit it, and success sets it.
        skill: The skill that executes its goals, as `crkr workers` names it; other commands use it as a default.
    """

    name: str
    state: tuple[StateDimension, ...]
    goal: tuple[GoalDimension, ...]
    description: str = ""
    seed: int = 0
    outcome: tuple[OutcomeEntry, ...] = ()
    exploration: Exploration = field(default_factory=Exploration)
    kernel: KernelSettings = field(default_factory=KernelSettings)
    budget: int = 250
    regularisation: float = 1.0
    cost_map: str = "linear"
    noise_floor: float = 1e-4
    learn_from: str = "successes"
    prior_mean: str = "demonstrations"
    explore_scale: float = 1.0
    exploration_floor: float = 0.0
    novel: str = "predict"
    novelty_limit: float = 0.9
    selector: str = "anms"
    refit_every: int = 0
    start: Start = field(default_factory=Start)
    cost: str = "measured"
    skill: str = ""

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], *, strict: bool = False) -> TaskSpec:
        """Reads a specification and fills in the defaults.

        Args:
            data: The fields of the class, lists of maps for the axes.
            strict: Refuse unknown fields too, for files that people write.

        Raises:
            Invalid: A required field is missing, or a value is of the wrong kind or out of range.
        """
        if not isinstance(data, Mapping):
            raise Invalid(f"a task specification is a map; got {type(data).__name__}")
        if strict:  # first: a missing field may be there under a misspelt name
            _refuse_unknown(data, cls.__dataclass_fields__, "the specification")
        fields: dict[str, Any] = {
            "name": check_name(required(data, "name")),
            "state": _axes(required(data, "state"), "state", StateDimension.from_dict),
            "goal": _axes(required(data, "goal"), "goal", GoalDimension.from_dict),
            "outcome": _axes(data.get("outcome") or [], "outcome", OutcomeEntry.from_dict, least=0),
        }
        default_exploration = {"type": "outcome" if fields["outcome"] else "gaussian"}
        fields["exploration"] = Exploration.from_dict(data.get("exploration", default_exploration))
        if fields["exploration"].type == "outcome" and not fields["outcome"]:
            raise Invalid('exploration.type "outcome" needs a declared outcome; declare one or use "gaussian"')
        for name, read in _SCALARS.items():
            if name in data:
                fields[name] = read(data[name])
        spec = cls(**fields)
        if strict:
            _refuse_unknown_within(data, spec.to_dict())
        return spec

    def to_dict(self) -> dict[str, Any]:
        """The specification as plain data, every default filled in; `from_dict` reads it back unchanged."""
        data = asdict(self)
        for name in ("state", "goal", "outcome"):
            data[name] = list(data[name])
        data["exploration"]["temperature"] = list(self.exploration.temperature)
        return data

    def with_changes(self, changes: Mapping[str, Any]) -> TaskSpec:
        """The specification with some settings changed, as `configure` allows.

        Raises:
            Invalid: A field that may not change after creation, or a bad value.
        """
        fixed = sorted(str(key) for key in changes if key not in CHANGEABLE)
        if fixed:
            raise Invalid(f"{', '.join(fixed)} cannot be changed; these can: {', '.join(CHANGEABLE)}")
        values = {name: _SCALARS[name](value) for name, value in changes.items() if name != "kernel"}
        if "kernel" in changes:
            given = changes["kernel"]
            if not isinstance(given, Mapping):
                raise Invalid(f"kernel must be a map; got {type(given).__name__}")
            values["kernel"] = KernelSettings.from_dict({**asdict(self.kernel), **given})
        return replace(self, **values)

    def fingerprint(self) -> str:
        """SHA-256 of the specification without its description and skill, as 64 hexadecimal digits."""
        data = self.to_dict()
        for name in _APART:
            del data[name]
        return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()

    def differences(self, other: TaskSpec) -> dict[str, list[Any]]:
        """Fields in which `other` differs, description and skill aside: name -> [this, other]."""
        mine, theirs = self.to_dict(), other.to_dict()
        if self.exploration.type == other.exploration.type == "gaussian" or (
            {self.exploration, other.exploration} == {Exploration(type="outcome"), EARLIER_EXPLORATION}
        ):
            del mine["exploration"]  # no effect, or the default of each version
        return {name: [mine[name], theirs[name]] for name in mine if name not in _APART and mine[name] != theirs[name]}

    @property
    def centres(self) -> Array:
        """(d,) midpoints of the state box."""
        return np.array([(axis.low + axis.high) / 2 for axis in self.state])

    @property
    def lengthscales(self) -> Array:
        """(d,) length-scales of the states."""
        return np.array([axis.lengthscale for axis in self.state])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """(p,) lowest and (p,) highest goals, both allowed."""
        return np.array([axis.low for axis in self.goal]), np.array([axis.high for axis in self.goal])

    @property
    def scales(self) -> Array:
        """(p,) scales of the goals."""
        return np.array([axis.scale for axis in self.goal])


def _refuse_unknown(given: Mapping[str, Any], known: Collection[str], where: str) -> None:
    if unknown := sorted(str(key) for key in given if key not in known):
        raise Invalid(f"unknown fields in {where}: {', '.join(unknown)}; known are {', '.join(known)}")


def _refuse_unknown_within(given: Mapping[str, Any], spelt_out: Mapping[str, Any]) -> None:
    """The same for axes and groups of settings; `spelt_out` is `given` with every default filled in."""
    for name, value in given.items():
        if isinstance(value, Mapping):
            _refuse_unknown(value, spelt_out[name], name)
        elif isinstance(value, list | tuple):
            for index, entry in enumerate(value):
                _refuse_unknown(entry, spelt_out[name][index], f"{name}[{index}]")


def _axes(value: object, name: str, read: Callable[[object, str], Any], least: int = 1) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple) or not least <= len(value) <= MAX_DIMENSIONS:
        got = f"{len(value)} entries" if isinstance(value, list | tuple) else type(value).__name__
        raise Invalid(f"{name} must be a list of {least} to {MAX_DIMENSIONS} entries; got {got}")
    axes = tuple(read(entry, f"{name}[{index}]") for index, entry in enumerate(value))
    names = [axis.name for axis in axes]
    if len(set(names)) != len(names):
        raise Invalid(f"names of {name} must differ; got {', '.join(names)}")
    return axes


_SCALARS: Final[Mapping[str, Callable[[object], Any]]] = {
    "description": lambda value: text(value, "description"),
    "seed": lambda value: integer(value, "seed"),
    "kernel": KernelSettings.from_dict,
    "budget": lambda value: integer(value, "budget", low=1, high=100_000),
    "regularisation": lambda value: number(value, "regularisation", above=0.0, high=LARGEST),
    "cost_map": lambda value: choice(value, "cost_map", ("linear", "odds")),
    "noise_floor": lambda value: number(value, "noise_floor", above=0.0, high=LARGEST),
    "learn_from": lambda value: choice(value, "learn_from", ("successes", "all")),
    "prior_mean": lambda value: choice(value, "prior_mean", ("zero", "demonstrations")),
    "explore_scale": lambda value: number(value, "explore_scale", low=0.0, high=LARGEST),
    "exploration_floor": lambda value: number(value, "exploration_floor", low=0.0, high=LARGEST),
    "novel": lambda value: choice(value, "novel", ("predict", "refuse")),
    "novelty_limit": lambda value: number(value, "novelty_limit", low=0.0, high=1.0),
    "selector": lambda value: choice(value, "selector", ("anms", "full", "freeze")),
    "refit_every": lambda value: integer(value, "refit_every"),
    "start": Start.from_dict,
    "cost": lambda value: choice(value, "cost", ("measured", "label")),
    "skill": lambda value: text(value, "skill", longest=1024),
}
