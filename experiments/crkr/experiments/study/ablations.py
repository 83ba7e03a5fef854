"""The learner with one part left out or changed: other settings, or less information.

Every change is a setting of the specification, or a filter on the learner's input; the learner has no code for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final, final

import numpy as np

from crkr.experiments.rivals.rival import Crkr, Rival
from crkr.learner import SELECTORS
from crkr.protocol import Array, TaskSpec
from crkr.sim_worker.skill import Demonstration, TrialResult

__all__ = ["ABLATIONS", "WHOLE", "Ablation"]

Told = Callable[[TaskSpec, TrialResult, np.random.Generator], TrialResult | None]
"""The learner's input from a trial; None: nothing."""

WHOLE: Final = "whole"
CHANGED_AFTER: Final = 200  # trials


@final
@dataclass(frozen=True)
class Ablation:
    """A change of the learner; called with a specification and a seed, it makes one.

    Attributes:
        settings: Fields of the specification that differ; `exploration` and `kernel` are merged into those there.
        told: Filters its input; None: no change.
        outcome: Declares other outcomes than the specification; None: its own.
        demonstrations: Largest number of demonstrations; None: all.
        offset: Offset that the robot adds to the goal's first entry from trial 200 on, unknown to the learner [scales].
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    told: Told | None = None
    outcome: tuple[Mapping[str, Any], ...] | None = None
    demonstrations: int | None = None
    offset: float = 0.0

    def __call__(self, spec: TaskSpec, seed: int) -> Rival:
        """A new learner."""
        plain = spec.to_dict()
        merged = {
            name: {**plain[name], **value} if isinstance(value, Mapping) else value
            for name, value in self.settings.items()
        }
        outcome = {} if self.outcome is None else {"outcome": self.outcome}
        return _AblatedLearner(self, spec, Crkr(TaskSpec.from_dict({**plain, **merged, **outcome}), seed), seed)


@final
class _AblatedLearner:
    """A `Rival` between the skill and the learner."""

    def __init__(self, ablation: Ablation, spec: TaskSpec, learner: Rival, seed: int) -> None:
        self._ablation, self._spec, self._learner = ablation, spec, learner
        self._rng, self._trials = np.random.default_rng([seed, 4]), 0
        self._step = np.zeros(len(spec.goal))
        self._step[0] = ablation.offset * spec.scales[0]

    def start(self, demonstrations: Sequence[Demonstration]) -> None:
        """Passes some of them on, filtered like trials."""
        shown = [(one, self._told(one.result)) for one in demonstrations[: self._ablation.demonstrations]]
        self._learner.start([replace(one, result=told) for one, told in shown if told is not None])

    def ask(self, state: Array) -> Array:
        """The goal that is executed, which the robot may change."""
        return self._moved(self._learner.ask(state))

    def tell(self, state: Array, goal: Array, result: TrialResult) -> None:
        """Passes the trial on, filtered."""
        self._trials += 1
        told = self._told(result)
        if told is not None:
            self._learner.tell(state, goal, told)

    def policy(self, states: Array) -> Array:
        """The goals that are executed."""
        return self._moved(self._learner.policy(states))

    def _told(self, result: TrialResult) -> TrialResult | None:
        change = self._ablation.told
        return result if change is None else change(self._spec, result, self._rng)

    def _moved(self, goals: Array) -> Array:
        if not self._ablation.offset or self._trials < CHANGED_AFTER:
            return goals
        low, high = self._spec.bounds
        moved: Array = np.clip(goals + self._step, low, high)
        return moved


def _deviations(spec: TaskSpec, outcome: Array) -> Array:
    """Deviations (q,) from the target in tolerances; 0 where more or less is as good, NaN where not observed."""
    found: Array = np.array(
        [(value - entry.target) / entry.tolerance for value, entry in zip(outcome, spec.outcome, strict=True)]
    )
    side = np.array([{"equal": 0, "at_least": 1, "at_most": -1}[entry.aim] for entry in spec.outcome])
    found[side * found > 0] = 0.0
    return found


def _distance(spec: TaskSpec, result: TrialResult, rng: np.random.Generator) -> TrialResult:
    """One number: how far off the trial was, in tolerances, of what was observed."""
    del rng  # Unused.
    if result.outcome is None:
        return result
    seen = _deviations(spec, result.outcome)
    seen = seen[~np.isnan(seen)]
    return replace(result, outcome=np.array([np.sqrt(seen @ seen) if len(seen) else np.nan]))


def _disturbed(
    spec: TaskSpec, result: TrialResult, rng: np.random.Generator, *, noise: float, bias: float
) -> TrialResult:
    """Every outcome with normal noise and a bias, in tolerances."""
    if result.outcome is None:
        return result
    tolerances = np.array([entry.tolerance for entry in spec.outcome])
    error = bias + noise * rng.standard_normal(len(tolerances))
    return replace(result, outcome=result.outcome + tolerances * error)


def _observed(spec: TaskSpec, result: TrialResult, rng: np.random.Generator, *, group: str) -> TrialResult:
    """The entries of one group; others count as not observed."""
    del rng  # Unused.
    if result.outcome is None:
        return result
    there = np.array([entry.group == group for entry in spec.outcome])
    return replace(result, outcome=np.where(there, result.outcome, np.nan))


def _executed(spec: TaskSpec, result: TrialResult, rng: np.random.Generator) -> TrialResult | None:
    """Drops refused goals."""
    del spec, rng  # Unused.
    return result if result.executed else None


def _bare_refusal(spec: TaskSpec, result: TrialResult, rng: np.random.Generator) -> TrialResult:
    """Keeps a refusal without its predicted outcome."""
    del rng  # Unused.
    return result if result.executed else replace(result, outcome=np.full(len(spec.outcome), np.nan))


def _guided(**settings: object) -> Ablation:
    return Ablation({"exploration": settings})


ABLATIONS: Final[Mapping[str, Ablation]] = {
    WHOLE: Ablation(),
    "no outcome": _guided(type="gaussian"),
    "one distance": Ablation(told=_distance, outcome=({"name": "distance", "unit": "tolerances", "tolerance": 1.0},)),
    "only where it hits": Ablation(told=partial(_observed, group="hit")),
    "only where it lands": Ablation(told=partial(_observed, group="landing")),
    "noise of one tolerance": Ablation(told=partial(_disturbed, noise=1.0, bias=0.0)),
    "bias of half a tolerance": Ablation(told=partial(_disturbed, noise=0.0, bias=0.5)),
    "noise and bias": Ablation(told=partial(_disturbed, noise=1.0, bias=0.5)),
    "straight line": _guided(model="line"),
    "quadratic": _guided(model="quadratic"),
    "nothing of refusals": Ablation(told=_executed),
    "refusals without outcome": Ablation(told=_bare_refusal),
    "no candidates": _guided(candidates=0),
    "means as answers": _guided(gate=1e6),
    "trust 1": _guided(trust=1.0),
    "trust 16": _guided(trust=16.0),
    "temperature 0.02": _guided(temperature=[0.02]),
    "temperature 0.1": _guided(temperature=[0.1]),
    "temperature 0.5": _guided(temperature=[0.5]),
    "temperature 1": _guided(temperature=[1.0]),
    "one iteration": _guided(iterations=1),
    "30 neighbours": _guided(neighbours=30),
    "200 neighbours": _guided(neighbours=200),
    "budget 25": Ablation({"budget": 25}),
    "budget 50": Ablation({"budget": 50}),
    "budget 250": Ablation({"budget": 250}),
    **{f"selector {name}": Ablation({"selector": name}) for name in SELECTORS if name != "anms"},
    "no linear term": Ablation({"kernel": {"linear_weight": 0.0}}),
    "one demonstration": Ablation(demonstrations=1),
    "no demonstration": Ablation(demonstrations=0),
    "robot changes": Ablation(offset=1.0),
    "robot changes, no restart": Ablation({"exploration": {"drift": False}}, offset=1.0),
}
