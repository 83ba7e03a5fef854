"""Advice on what keeps a task from learning, by rules over its newest trials.

The rules use logged trials only, so a restarted server gives the same advice. A rule needs a minimum of trials.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.learner.exploration.outcome_learner import Drift
from crkr.learner.samples.history import WINDOW, TrialHistory
from crkr.protocol import MOST_KEPT, Array, TaskSpec

__all__ = ["ADVICE_CODES", "Advice", "advise"]

_FEWEST: Final = 50  # trials; with fewer, only the rules about single numbers apply
_NEARLY_ALL: Final = 0.9
_HALF: Final = 0.5
_SOME: Final = 0.1
_GOOD: Final = 0.8  # success rate above which an outcome is not needed
_NEAR_BOUND: Final = 0.005  # of a bound's range
_SATURATED: Final = 0.999  # costs above this are indistinguishable
_CERTAIN: Final = 1e-6  # a success that costs less ends exploration
_RECENT: Final = 1000  # log positions for which a drift is reported


class Advice(NamedTuple):
    """One thing that limits learning.

    Attributes:
        code: "no_success", "cost_saturated", "goals_on_bounds", "no_outcome", "outcome_constant", "state_outside",
            "many_refusals", "drifted" or "full".
        message: What is wrong, and what to do.
    """

    code: str
    message: str


@final
@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Input of the rules: the task and its newest trials, executed or refused.

    Attributes:
        spec: The specification in force.
        states: (n, d).
        goals: (n, p).
        outcomes: (n, q); q is 0 where the task does not learn from them.
        costs: (n,).
        executed: (n,) which were executed.
        success: (n,) which succeeded.
        drift: Whether the robot changes; None where no outcome is modelled.
        version: Log position of the newest trial.
        eligible: How many trials may be learned from.
        active: How many are in the model.
    """

    spec: TaskSpec
    states: Array
    goals: Array
    outcomes: Array
    costs: Array
    executed: NDArray[np.bool_]
    success: NDArray[np.bool_]
    drift: Drift | None
    version: int
    eligible: int
    active: int

    def __len__(self) -> int:
        return len(self.costs)


def advise(spec: TaskSpec, history: TrialHistory, drift: Drift | None, eligible: int, active: int) -> list[Advice]:
    """What limits a task's learning, the most urgent first; [] without a limit.

    Args:
        spec: The specification in force.
        history: The task's trials.
        drift: Whether the robot changes; None where no outcome is modelled.
        eligible: How many trials may be learned from.
        active: How many are in the model.
    """
    rows = history.newest_tried(WINDOW)
    seen = _Seen(
        spec,
        history.states[rows],
        history.goals[rows],
        history.outcomes[rows],
        history.costs[rows],
        history.executed(rows),
        history.successes(rows),
        drift,
        int(history.seqs[-1]) if len(history.seqs) else 1,
        eligible,
        active,
    )
    told = ((code, rule(seen)) for code, rule in _RULES)
    return [Advice(code, message) for code, message in told if message is not None]


def _no_success(seen: _Seen) -> str | None:
    if len(seen) < WINDOW or seen.success.any():
        return None
    return (
        f"no success in {WINDOW} trials: check that the skill reports `success`, narrow the goal's bounds to what is "
        "sensible, or report a demonstration"
    )


def _cost_saturated(seen: _Seen) -> str | None:
    """A cost without information, where costs are learned from."""
    guided = seen.spec.exploration.type == "outcome"
    costs = seen.costs[seen.executed]
    if len(costs) >= _FEWEST and (not guided or seen.spec.learn_from == "all"):
        share = float((costs >= _SATURATED).mean())
        if share >= _NEARLY_ALL:
            return (
                f"cost saturated: {share:.0%} of the newest {len(costs)} executed trials cost {_SATURATED} or more, "
                "so that better and worse look alike; scale the cost until failures differ, or declare an outcome"
            )
    certain = seen.costs[seen.executed & seen.success]
    if len(certain) >= _FEWEST // 2 and not guided:
        share = float((certain <= _CERTAIN).mean())
        if share >= _NEARLY_ALL:
            return (
                f"cost saturated: {share:.0%} of the newest {len(certain)} successes cost 0, which says that they "
                'cannot be better and ends exploration; report 0.1 or more, or make the task with cost = "label"'
            )
    return None


def _goals_on_bounds(seen: _Seen) -> str | None:
    if len(seen) < _FEWEST:
        return None
    low, high = seen.spec.bounds
    margin = _NEAR_BOUND * high - _NEAR_BOUND * low
    share = ((seen.goals <= low + margin) | (seen.goals >= high - margin)).mean(axis=0)
    names = _named(share >= _HALF, [axis.name for axis in seen.spec.goal])
    if names is None:
        return None
    return (
        f"goals on their bounds: {share.max():.0%} of the newest {len(seen)} goals are at a bound of {names}; widen "
        "these bounds in a new task if the robot allows it"
    )


def _no_outcome(seen: _Seen) -> str | None:
    if not seen.spec.outcome:
        rate = float(seen.success.mean()) if len(seen) else 1.0
        if len(seen) < WINDOW or rate >= _GOOD:
            return None
        return (
            f"declare an outcome: {rate:.0%} of the newest {len(seen)} trials succeeded, and a signed number that says "
            "how a trial missed lets every miss teach (docs/outcomes.md)"
        )
    measured = seen.outcomes[seen.executed]
    if not measured.shape[1] or len(measured) < _FEWEST:
        return None
    never = np.asarray(np.isnan(measured).all(axis=0))
    names = _named(never, [entry.name for entry in seen.spec.outcome])
    if names is None:
        return None
    return f"outcome {names} was not observed in any of the newest {len(measured)} executed trials: report it"


def _outcome_constant(seen: _Seen) -> str | None:
    measured = seen.outcomes
    if not measured.shape[1]:
        return None
    known = ~np.isnan(measured)
    highest = np.where(known, measured, -np.inf).max(axis=0, initial=-np.inf)
    lowest = np.where(known, measured, np.inf).min(axis=0, initial=np.inf)
    constant = (known.sum(axis=0) >= _FEWEST) & (highest == lowest)
    for place, entry in enumerate(seen.spec.outcome):  # an entry that always meets its target need not change
        side = {"at_least": 1.0, "at_most": -1.0}.get(entry.aim)
        if side is not None and side * (lowest[place] - entry.target) >= 0.0:
            constant[place] = False
    names = _named(constant, [entry.name for entry in seen.spec.outcome])
    if names is None:
        return None
    return f"outcome {names} is the same in every trial, so it says nothing about the goal: report a measured number"


def _state_outside(seen: _Seen) -> str | None:
    if len(seen) < _FEWEST:
        return None
    low, high = (np.array([getattr(axis, end) for axis in seen.spec.state]) for end in ("low", "high"))
    share = ((seen.states < low) | (seen.states > high)).mean(axis=0)
    names = _named(share >= _SOME, [axis.name for axis in seen.spec.state])
    if names is None:
        return None
    return (
        f"states outside their box: {share.max():.0%} of the newest {len(seen)} states are outside of low and high of "
        f"{names}, from which distances are scaled; declare the box that states come from"
    )


def _many_refusals(seen: _Seen) -> str | None:
    share = 1.0 - float(seen.executed.mean()) if len(seen) else 0.0
    if len(seen) < _FEWEST or share < _HALF:
        return None
    return (
        f"many refusals: {share:.0%} of the newest {len(seen)} goals were not executed (kind failed); narrow the "
        "goal's bounds to what the robot can do"
    )


def _drifted(seen: _Seen) -> str | None:
    drift = seen.drift
    if drift is None or drift.last_seq is None or seen.version - drift.last_seq > _RECENT:
        return None
    times = "once" if drift.restarts == 1 else f"{drift.restarts} times"
    return (
        f"the robot changed: outcomes were not as predicted, so the outcome model restarted {times}, last at log "
        f"position {drift.last_seq}; look at the robot if nobody changed it"
    )


def _full(seen: _Seen) -> str | None:
    if seen.spec.selector != "full" or not seen.eligible > seen.active >= MOST_KEPT:
        return None
    return (
        f'selector "full" learns from the first {MOST_KEPT} of {seen.eligible} trials; the others are stored. '
        'Import them into a task with selector "anms" to learn from all'
    )


_RULES: Final[Sequence[tuple[str, Callable[[_Seen], str | None]]]] = (
    ("drifted", _drifted),
    ("no_success", _no_success),
    ("many_refusals", _many_refusals),
    ("cost_saturated", _cost_saturated),
    ("outcome_constant", _outcome_constant),
    ("no_outcome", _no_outcome),
    ("goals_on_bounds", _goals_on_bounds),
    ("state_outside", _state_outside),
    ("full", _full),
)
ADVICE_CODES: Final = tuple(code for code, _ in _RULES)


def _named(which: NDArray[np.bool_], names: Sequence[str]) -> str | None:
    """Some of the names in one line; None without names."""
    chosen = [name for name, told in zip(names, which.tolist(), strict=True) if told]
    return ", ".join(chosen[:5]) + (f" and {len(chosen) - 5} more" if len(chosen) > 5 else "") if chosen else None
