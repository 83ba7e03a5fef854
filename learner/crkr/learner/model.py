"""The policy at one moment: an immutable snapshot that answers while learning makes the next one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner.exploration.draws import space_filling
from crkr.learner.exploration.explorer import Explorer, GaussianExplorer
from crkr.learner.exploration.success import SuccessRate
from crkr.learner.parameters import Parameters
from crkr.learner.regression import KernelMaker, Regression
from crkr.protocol import Array, Invalid, NoSamples, NovelState, Prediction, check_states, id_from_wire
from crkr.protocol.checks import finite_array
from crkr.protocol.codec import array_from_wire

__all__ = ["Model"]

_UNLIKE: Final = 0.99  # novelty of a state far from all samples


@final
@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Active samples, their regression and the settings; every array is read-only. Make it with `create`.

    Attributes:
        version: Log position that it has applied.
        parameters: The settings.
        ids: (m,) ids of the active samples, in the order of the log.
        states: (m, d) their states [units of the state].
        goals: (m, p) their goals [units of the goal].
        costs: (m,) their costs.
        regression: Posterior of the scaled goals; None while there is no active sample.
        explorer: Chooses the goals.
        tried: Number of reported trials, successes or not.
        rate: P(success) where the explorer has none; None: no trial was reported yet.
    """

    version: int
    parameters: Parameters
    ids: tuple[UUID, ...]
    states: Array
    goals: Array
    costs: Array
    regression: Regression | None
    explorer: Explorer
    tried: int = 0
    rate: SuccessRate | None = None

    @classmethod
    def create(
        cls,
        version: int,
        parameters: Parameters,
        ids: Sequence[UUID],
        states: Array,
        goals: Array,
        costs: Array,
        previous: Model | None = None,
        explorer: Explorer | None = None,
        matrix: KernelMaker | None = None,
        tried: int = 0,
        rate: SuccessRate | None = None,
    ) -> Model:
        """Fits the regression to these samples, O(m^3); `previous` saves most of it if samples were only added.

        The arrays become read-only. Without an explorer the model explores as the paper does. For `matrix` see
        `Regression.fit`.
        """
        for array in (states, goals, costs):
            array.setflags(write=False)
        regression = None
        if len(costs):
            kernel = parameters.kernel
            scaled = (goals - parameters.prior) / parameters.scales
            earlier, noise = previous.regression if previous is not None else None, parameters.noise(costs)
            regression = Regression.fit(kernel, kernel.standardise(states), scaled, noise, earlier, matrix)
        explorer = explorer or GaussianExplorer(parameters.seed, parameters.low, parameters.high)
        return cls(version, parameters, tuple(ids), states, goals, costs, regression, explorer, tried, rate)

    def at_version(self, version: int, explorer: Explorer, tried: int, rate: SuccessRate | None) -> Model:
        """The same regression at a later version."""
        return replace(self, version=version, explorer=explorer, tried=tried, rate=rate)

    @property
    def active(self) -> int:
        """Number of active samples."""
        return len(self.ids)

    def predict(
        self, states: object, explore: bool = False, trial_ids: Sequence[UUID | bytes] | UUID | bytes | None = None
    ) -> Prediction:
        """Goals for one state or many  [Cardoso2017, alg. 1].

        Means are prior + scale * mean, not clipped. Sigmas are scale * explore_scale * sqrt(variance + floor). Goals
        are the explorer's. As in the paper, they are the means, clipped to the bounds, or with `explore` independent
        draws from N(mean, sigma^2) truncated to the bounds, a pure function of the model, the task's seed and the trial
        ids. Where measured outcomes guide it, see `OutcomeExplorer`.

        Args:
            states: (d,) or (b, d) [units of the state].
            explore: Draw goals to try.
            trial_ids: One for each state; required to explore.

        Returns:
            Goals (p,) or (b, p) [units of the goal], novelty () or (b,), and the ids as given.

        Raises:
            Invalid: States of another shape or not finite; ids missing, not 16 bytes, repeated, or not one for each
                state.
            NoSamples: No sample is active.
            NovelState: A state is more novel than the task allows.
        """
        checked = check_states(states, len(self.parameters.kernel.centre))
        count = 1 if checked.ndim == 1 else len(checked)
        return self.answer(checked, explore, _checked_ids(trial_ids, count, explore))

    def answer(self, states: Array, explore: bool, ids: list[UUID]) -> Prediction:
        """`predict` for states (d,) or (b, d) and ids that are checked already."""
        regression, own = self.regression, self.parameters
        z = own.kernel.standardise(states)
        if regression is None:
            means, sigmas, novelty = self._prior(states, explore)
            unlike = 0.0
        elif z.ndim == 1:
            mean, variance, prior = regression.at(z)
            sigmas = own.scales * (own.explore_scale * math.sqrt(variance + own.exploration_floor))
            unlike = min(variance / prior, 1.0)
            novelty = np.array(unlike)
        else:
            mean, variances, priors = regression.over(z)
            sigmas = own.scales * (own.explore_scale * np.sqrt(variances + own.exploration_floor))[:, None]
            novelty = np.minimum(variances / priors, 1.0)
            unlike = float(novelty.max(initial=0.0))
        if own.novelty_limit is not None:
            _refuse_novel(novelty, own.novelty_limit, own.task)
        if regression is not None:
            means = np.multiply(mean, own.scales, out=mean)
            means += own.prior
        if explore and (self.tried < own.start.count or not (self.explorer.guides or regression)):
            goals = space_filling(own.seed, ids, self.tried, own.low, own.high).reshape(means.shape)
            corrected = outcome = deviation = chance = None
        elif explore:
            goals, corrected, outcome, deviation, chance = self.explorer.draw(states, means, sigmas, ids)
        else:
            goals, corrected, outcome, deviation, chance = self.explorer.best(states, means, sigmas)
        if chance is None:
            chance = np.full(z.shape[:-1], np.nan) if self.rate is None else self.rate.at(z)
        if unlike > _UNLIKE:  # samples elsewhere carry no information here
            chance = np.where(novelty > _UNLIKE, np.nan, chance)
        for array in (goals, means, sigmas, novelty, corrected, outcome, deviation, chance):
            if array is not None:
                array.setflags(write=False)
        policy = "explore" if explore else "mean"
        if corrected is not None and corrected.any():
            policy = "corrected"
        return Prediction(
            states, goals, means, sigmas, novelty, ids, self.version, len(self.ids), policy, outcome, deviation,
            corrected=corrected, success_probability=chance,
        )  # fmt: skip

    def _prior(self, states: Array, explore: bool) -> tuple[Array, Array, Array]:
        """Means, sigmas and novelties without an active sample: guided by outcomes alone, or filling space.

        Raises:
            NoSamples: Nothing is known yet, and no exploration was asked for.
        """
        own, guides = self.parameters, self.explorer.guides
        if not guides and (own.start.type == "demonstrations" or not explore):
            raise NoSamples(f"task {own.task!r} has no active sample; report a demonstration or a success first")
        shape = (*states.shape[:-1], len(own.scales))
        means = self.explorer.best_tried(states) if guides else np.broadcast_to(own.prior, shape).copy()
        return means, np.broadcast_to(own.explore_scale * own.scales, shape).copy(), np.ones(states.shape[:-1])

    def to_wire(self) -> dict[str, Any]:
        """The model as data, as the `model` query returns it."""
        samples = {"states": self.states, "goals": self.goals, "costs": self.costs, "ids": list(self.ids)}
        rate = {} if self.rate is None else {"recent": {"states": self.rate.standardised, "success": self.rate.success}}
        return {"version": self.version, **samples, **self.parameters.to_wire(), **rate}

    @classmethod
    def from_wire(cls, message: Mapping[str, Any]) -> Model:
        """Rebuilds a model from `to_wire`, which gives the same answers.

        Raises:
            Invalid: A field is missing or has another form.
        """
        parameters = Parameters.from_wire(message)
        try:
            version, ids = int(message["version"]), [id_from_wire(value, "ids") for value in message["ids"]]
            given = {name: message[name] for name in ("states", "goals", "costs")}
        except (KeyError, TypeError, ValueError) as error:
            raise Invalid(f"a model must be as `model` returns it; {error!r}") from error
        arrays = {name: _array(value, name) for name, value in given.items()}
        m, d, p = len(ids), len(parameters.kernel.centre), len(parameters.scales)
        return cls.create(
            version,
            parameters,
            ids,
            finite_array(arrays["states"].reshape(-1, d), "states", (m, d)),
            finite_array(arrays["goals"].reshape(-1, p), "goals", (m, p)),
            finite_array(arrays["costs"], "costs", (m,)),
            rate=_rate(message.get("recent"), d),
        )


def _refuse_novel(novelty: Array, limit: float, task: str) -> None:
    index, worst = int(np.argmax(novelty)), float(np.max(novelty))
    if worst > limit:
        raise NovelState(
            f"state {index} has novelty {worst:.3f}; task {task!r} refuses above {limit}",
            details={"index": index, "novelty": worst, "limit": limit},
        )


def _checked_ids(given: Sequence[UUID | bytes] | UUID | bytes | None, count: int, needed: bool) -> list[UUID]:
    if given is None:
        if needed:
            raise Invalid("trial_ids are required to explore: the draw depends on them")
        return []
    listed = [given] if isinstance(given, UUID | bytes) else list(given)
    ids = [id_from_wire(value, "trial_ids") for value in listed]
    if len(ids) != count or len({one.int for one in ids}) != count:  # hashing UUIDs takes twice as long
        raise Invalid(f"trial_ids must be {count} different ids, one a state; got {len(ids)}")
    return ids


def _rate(recent: object, d: int) -> SuccessRate | None:
    """The newest trials of a model as data, standardised; None from a server of version 0.1."""
    if not isinstance(recent, Mapping):
        return None
    success = finite_array(_array(recent.get("success"), "recent.success"), "recent.success", (None,))
    states = _array(recent.get("states"), "recent.states").reshape(-1, d)
    checked = finite_array(states, "recent.states", (len(success), d))
    return SuccessRate(lambda: (checked, success))


def _array(value: object, name: str) -> Array:
    return value if isinstance(value, np.ndarray) else array_from_wire(value, name)
