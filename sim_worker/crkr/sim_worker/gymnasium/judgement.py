"""Judges an episode: its outcome, success and cost."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, final

import gymnasium
import numpy as np

from crkr.protocol import Array, Invalid
from crkr.protocol.errors import shown

__all__ = ["Cost", "Episode", "Judgement", "Measure", "Success", "judge_by"]

logger = logging.getLogger(__name__)

Measure = Callable[[Any, Mapping[str, Any]], Mapping[str, float]]
"""An outcome: numbers by name, from the unwrapped environment and its last info; 0 is perfect."""
Success = str | Callable[[Any, Mapping[str, Any]], bool]
Cost = tuple[str, float, float] | Callable[[Any, Mapping[str, Any]], float]

FLAGS: Final = ("is_success", "success")
GOOD: Final = 90  # percentile of random episodes' returns that is the default for success
FAR: Final = 5.0  # tolerances off the target that cost 0.63
WATCHED: Final = 100  # costs considered for a warning of saturation


@final
@dataclass(frozen=True, slots=True)
class Episode:
    """How an episode ended.

    Attributes:
        env: The unwrapped environment.
        observation: The last one.
        total: Sum of the rewards, the return.
        info: The environment's info at the last step.
    """

    env: gymnasium.Env[Any, Any]
    observation: Any
    total: float
    info: Mapping[str, Any]


@final
class Judgement:
    """Outcome, success and cost of episodes by one rule.

    Attributes:
        names: Of the outcome's numbers.
        tolerances: (q,) within which a trial succeeds.
        rule: In words, for people.

    Args:
        measure: Of the outcome, or None.
        tolerances: Of its numbers.
        succeeded: Whether an episode succeeded.
        cost: Clipped to [0, 1].
        rule: In words.
    """

    def __init__(
        self,
        measure: Callable[[Episode], Mapping[str, float]] | None,
        tolerances: Mapping[str, float],
        succeeded: Callable[[Episode], bool],
        cost: Callable[[Episode], float],
        rule: str,
    ) -> None:
        self.names = tuple(tolerances)
        self.tolerances = np.array(list(tolerances.values()))
        self.rule = rule
        self._measure = measure
        self._succeeded = succeeded
        self._cost = cost
        self._costs: list[float] = []

    @property
    def axes(self) -> list[dict[str, Any]]:
        """The specification's `outcome`; may be empty."""
        pairs = zip(self.names, self.tolerances.tolist(), strict=True)
        return [{"name": name, "tolerance": tolerance, "group": "outcome"} for name, tolerance in pairs]

    def outcome(self, episode: Episode) -> Array | None:
        """Its numbers (q,)."""
        if self._measure is None:
            return None
        measured = self._measure(episode)
        return np.array([float(measured[name]) for name in self.names])

    def success(self, episode: Episode) -> bool:
        """Whether it succeeded."""
        return bool(self._succeeded(episode))

    def cost(self, episode: Episode) -> float:
        """Its cost; warns of saturated costs."""
        cost = float(np.clip(self._cost(episode), 0.0, 1.0))
        self._costs.append(cost)
        if len(self._costs) == WATCHED:
            for end, said in ((0.0, "as cheap"), (1.0, "as costly")):
                if np.mean(np.array(self._costs) == end) > 0.5:
                    logger.warning(
                        "more than half of %d trials are %s as cost can tell; give its range: "
                        'gymnasium_skill(..., cost=("return", WORST, BEST))',
                        WATCHED,
                        said,
                    )
            self._costs.clear()
        return cost


def judge_by(
    first: Episode,
    returns: Callable[[], Array],
    name: str,
    *,
    success: Success | None,
    cost: Cost | None,
    outcome: Measure | None,
    tolerance: float | Mapping[str, float] | None,
) -> Judgement:
    """The rule from the arguments of `gymnasium_skill`, with defaults from the environment.

    Args:
        first: An episode that has just ended.
        returns: Returns the returns (n,) of random episodes; called if nothing else defines a cost.
        name: Of the environment, for messages.
        success: A flag of the environment's info, or a function.
        cost: ("return", worst, best), or a function.
        outcome: Measures a trial.
        tolerance: Of the outcome's numbers.

    Raises:
        Invalid: The environment's episodes lack what an argument names, or an outcome has no tolerance.
    """
    measure = _measure(first, outcome)
    tolerances = {} if measure is None else _tolerances(measure(first), first, name, tolerance)

    @cache
    def finite_returns() -> Array:
        found = returns()
        if not np.isfinite(found).all():
            odd = found[~np.isfinite(found)][0]
            raise Invalid(
                f"{name}: the return of a random episode is {odd}; give a finite cost=..., or mend its rewards"
            )
        return found

    succeeded, rule = _success(first, finite_returns, name, success, measure, tolerances)
    return Judgement(measure, tolerances, succeeded, _cost(finite_returns, cost, measure, tolerances), rule)


def _measure(episode: Episode, given: Measure | None) -> Callable[[Episode], Mapping[str, float]] | None:
    if given is not None:
        return lambda episode: given(episode.env, episode.info)
    seen = episode.observation
    if not (isinstance(seen, Mapping) and {"achieved_goal", "desired_goal"} <= set(seen)):
        return None

    def missed(episode: Episode) -> Mapping[str, float]:
        off = np.ravel(episode.observation["achieved_goal"]) - np.ravel(episode.observation["desired_goal"])
        return {f"off_{index}": float(value) for index, value in enumerate(off)}

    return missed


def _tolerances(
    measured: Mapping[str, float], episode: Episode, name: str, given: float | Mapping[str, float] | None
) -> dict[str, float]:
    if not isinstance(measured, Mapping) or not measured:
        raise Invalid(f"{name}: outcome must measure a map of numbers, as {{'off_x': 0.1}}; got {shown(measured)}")
    names = list(measured)
    if isinstance(given, Mapping):
        lacking = [one for one in names if one not in given]
        if lacking:
            raise Invalid(f"{name}: outcome {lacking[0]!r} has no tolerance; add it to tolerance={{...}}")
        return {one: float(given[one]) for one in names}
    if given is not None:
        return dict.fromkeys(names, float(given))
    threshold = getattr(episode.env, "distance_threshold", None)  # of gymnasium-robotics
    if threshold is not None:
        return dict.fromkeys(names, float(threshold) / len(names) ** 0.5)
    raise Invalid(
        f"{name}: an outcome needs a tolerance, the deviation from 0 that still succeeds: "
        f"gymnasium_skill({name!r}, outcome=..., tolerance=0.05)"
    )


def _success(
    first: Episode,
    returns: Callable[[], Array],
    name: str,
    given: Success | None,
    measure: Callable[[Episode], Mapping[str, float]] | None,
    tolerances: Mapping[str, float],
) -> tuple[Callable[[Episode], bool], str]:
    if callable(given):
        return lambda episode: bool(given(episode.env, episode.info)), "success as defined"
    flag = given or next((flag for flag in FLAGS if flag in first.info), None)
    if flag is not None:
        if flag not in first.info:
            known = ", ".join(sorted(first.info)) or "nothing"
            raise Invalid(f"{name} tells no {flag!r} at the end of an episode; it tells {known}")
        if np.asarray(first.info[flag]).dtype.kind not in "biuf":
            raise Invalid(f"{name}: {flag} must be true or false; got {shown(first.info[flag])}")
        return lambda episode: bool(np.all(episode.info[flag])), f"success is {flag}"
    if measure is not None:
        return lambda episode: _deviation(measure(episode), tolerances) <= 1.0, "success is an outcome in tolerance"
    good = float(np.percentile(returns(), GOOD))
    said = f"success is a return of at least {good:.4g}, which one random trial in ten reaches; better define it"
    return lambda episode: episode.total >= good, said


def _cost(
    returns: Callable[[], Array],
    given: Cost | None,
    measure: Callable[[Episode], Mapping[str, float]] | None,
    tolerances: Mapping[str, float],
) -> Callable[[Episode], float]:
    if callable(given):
        return lambda episode: float(given(episode.env, episode.info))
    if given is None and measure is not None:
        return lambda episode: 1.0 - float(np.exp(-_deviation(measure(episode), tolerances) / FAR))
    if given is None:
        worst, middle, best = np.percentile(returns(), (5, 50, 100))
        best += 0.1 * (best - middle)  # learning finds better ones than random goals
        best = best if best > worst else worst + 1.0
    else:
        kind, worst, best = given if isinstance(given, tuple | list) and len(given) == 3 else (None, 0.0, 0.0)
        if kind != "return" or not worst < best:
            raise Invalid(f'cost must be ("return", WORST, BEST) with WORST < BEST, or a function; got {given!r}')
    return lambda episode: float((best - episode.total) / (best - worst))


def _deviation(measured: Mapping[str, float], tolerances: Mapping[str, float]) -> float:
    """Distance from the target, in tolerances."""
    return float(np.sqrt(sum((measured[name] / tolerance) ** 2 for name, tolerance in tolerances.items())))
