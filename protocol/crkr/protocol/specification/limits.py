"""Limits of a task's numbers: products, quotients and sums stay finite, and the task can be served and sent.

An earlier version may have accepted other numbers. Such a specification is still read, so the limits apply where a
number is new: at `create_task`, and at `configure` for what changes.

How much one message holds follows from the dimensions: a state, a goal and an outcome have d, p and q numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from crkr.protocol.codec import MAX_MESSAGE_BYTES, MAX_STATES
from crkr.protocol.errors import Invalid

if TYPE_CHECKING:
    from crkr.protocol.specification.task_spec import TaskSpec

__all__ = [
    "MOST_ACTIVE",
    "MOST_KEPT",
    "MOST_NEIGHBOURS",
    "MOST_RECENT",
    "check_model_fits",
    "most_active",
    "most_states",
    "most_states_answered",
    "refuse_absurd",
]

MOST_ACTIVE: Final = 5000  # samples in a model: a new one takes about a second then, and 200 MB
MOST_KEPT: Final = 3000  # samples that the selector "full", which has no budget, learns from
MOST_NEIGHBOURS: Final = 200  # trials that a local outcome model is fitted to, in cubic time
_LARGEST: Final = 1e100  # coordinates in their units, whose squares are numbers too
_SMALLEST: Final = 1e-100  # lengths in the units of their coordinates
_FINEST: Final = 1e12  # length-scales that a coordinate may be or span; beyond, float64 is too coarse
_LEAST_VARIANCE: Final = 1e-12  # of scaled goals
_LEAST: Final = 1e-30  # of settings in scaled units that are not zero
_MOST_TEMPERATURES: Final = 64
_MOST_STEPS: Final = 2e8  # multiplications of the outcome model for one prediction: some 50 ms
MOST_RECENT: Final = 200  # newest trials in a model
_NUMBER: Final = 8  # bytes in a message
_ID: Final = 18  # with its header
_REST: Final = 4096  # names of fields, and what a message holds once

_Fault = tuple[str, str]  # a field, and what is wrong with it


def refuse_absurd(spec: TaskSpec, before: TaskSpec | None = None) -> None:
    """Raises `Invalid` for the first number that is beyond the limits.

    Args:
        spec: The new specification.
        before: The current one; its own faults are not held against the change.
    """
    known = set() if before is None else set(_faults(before))
    for field, wrong in _faults(spec):
        if (field, wrong) not in known:
            raise Invalid(f"{field} {wrong}", details={"field": field})


def _faults(spec: TaskSpec) -> Iterator[_Fault]:
    for index, state in enumerate(spec.state):
        where = f"state[{index}]"
        yield from _box(where, state.low, state.high)
        yield from _length(f"{where}.lengthscale", state.lengthscale, state.high - state.low)
        if not state.high - state.low <= _FINEST * state.lengthscale:
            yield f"{where}.lengthscale", f"must be at least {1 / _FINEST:g} of high - low; got {state.lengthscale}"
    for index, goal in enumerate(spec.goal):
        where = f"goal[{index}]"
        yield from _box(where, goal.low, goal.high)
        yield from _length(f"{where}.scale", goal.scale, goal.high - goal.low)
        if not max(abs(goal.low), abs(goal.high)) <= _FINEST * goal.scale:
            yield f"{where}.scale", f"must be at least {1 / _FINEST:g} of the bounds; got {goal.scale}"
    for index, entry in enumerate(spec.outcome):
        where = f"outcome[{index}]"
        yield from _within(f"{where}.target", entry.target, -_LARGEST, _LARGEST)
        yield from _within(f"{where}.tolerance", entry.tolerance, _SMALLEST, _LARGEST)
        if not abs(entry.target) <= _FINEST * entry.tolerance:
            yield f"{where}.tolerance", f"must be at least {1 / _FINEST:g} of the target; got {entry.tolerance}"
    yield from _settings(spec)
    yield from _exploration(spec)
    yield from _size(spec)


def _settings(spec: TaskSpec) -> Iterator[_Fault]:
    yield from _within("kernel.signal_variance", spec.kernel.signal_variance, _LEAST_VARIANCE)
    yield from _zero_or("kernel.linear_weight", spec.kernel.linear_weight, _LEAST_VARIANCE)
    yield from _within("noise_floor", spec.noise_floor, _LEAST)
    yield from _within("regularisation", spec.regularisation, _LEAST)
    yield from _zero_or("explore_scale", spec.explore_scale, _LEAST)
    yield from _zero_or("exploration_floor", spec.exploration_floor, _LEAST)


def _exploration(spec: TaskSpec) -> Iterator[_Fault]:
    own = spec.exploration
    yield from _within("exploration.trust", own.trust, _LEAST)
    yield from _within("exploration.temperature", min(own.temperature), _LEAST)
    yield from _zero_or("exploration.gate", own.gate, _LEAST)
    yield from _within("exploration.gate", own.gate, 0.0, _LARGEST)
    if len(own.temperature) > _MOST_TEMPERATURES:
        yield "exploration.temperature", f"must have at most {_MOST_TEMPERATURES} entries; got {len(own.temperature)}"
    if own.type == "outcome":
        width, groups = 1 + len(spec.state) + len(spec.goal), len({entry.group for entry in spec.outcome})
        near = min(own.neighbours, MOST_NEIGHBOURS)
        steps = own.iterations * own.neighbours * width * width + 2 * near**3 + own.candidates * near * (near + width)
        if groups * steps > _MOST_STEPS:
            yield (
                "exploration.neighbours",
                f"are too many for {groups} groups of outcomes, {own.iterations} iterations, {own.candidates} "
                f"candidates and {width - 1} states and goals: a prediction would take {groups * steps:.0f} "
                f"multiplications, and {_MOST_STEPS:.0f} is the most that does not hold others up",
            )


def _size(spec: TaskSpec) -> Iterator[_Fault]:
    if spec.budget > MOST_ACTIVE:
        yield "budget", f"must be at most {MOST_ACTIVE}, or learning takes seconds a trial; got {spec.budget}"


def _box(where: str, low: float, high: float) -> Iterator[_Fault]:
    yield from _within(f"{where}.low", low, -_LARGEST, _LARGEST)
    yield from _within(f"{where}.high", high, -_LARGEST, _LARGEST)
    if low < high:
        yield from _within(f"{where}.high - low", high - low, _SMALLEST)


def _length(field: str, length: float, span: float) -> Iterator[_Fault]:
    yield from _within(field, length, _SMALLEST, _LARGEST)
    if span > 0 and not length <= _FINEST * span:
        yield field, f"must be at most {_FINEST:g} times high - low; got {length}"


def _within(field: str, value: float, low: float, high: float = math.inf) -> Iterator[_Fault]:
    if not low <= value <= high:
        wanted = f"at least {low:g}" if high == math.inf else f"in [{low:g}, {high:g}]"
        yield field, f"must be {wanted}; got {value!r}"


def _zero_or(field: str, value: float, least: float) -> Iterator[_Fault]:
    if 0 < value < least:
        yield field, f"must be 0, or at least {least:g}; got {value!r}"


def most_states_answered(outputs: int, measured: int) -> int:
    """States whose predictions fit into one answer.

    Args:
        outputs: p.
        measured: q where outcomes guide the goals, so that an answer predicts them; else 0.
    """
    numbers = 3 * outputs + 2 + 2 * measured  # goals, means, sigmas, novelty, P(success); outcomes, deviations
    return min((MAX_MESSAGE_BYTES - _REST) // (_NUMBER * numbers + _ID), MAX_STATES)


def most_states(spec: TaskSpec) -> int:
    """States that fit into one question, with an id each, and their predictions into its answer."""
    asked = (MAX_MESSAGE_BYTES - _REST) // (_NUMBER * len(spec.state) + _ID)
    return min(asked, most_states_answered(len(spec.goal), len(spec.outcome)))


def most_active(states: int, goals: int) -> int:
    """Active samples of a model that fits into one answer, for d = `states` and p = `goals`."""
    recent = MOST_RECENT * (states + 1)  # trials for the probability of success
    once = _REST + _NUMBER * (2 * states + 4 * goals + recent)  # the settings
    return (MAX_MESSAGE_BYTES - once) // (_NUMBER * (states + goals + 1) + _ID)


def check_model_fits(spec: TaskSpec) -> None:
    """Raises `Invalid` for a budget whose model no message could carry to a mirror."""
    states, goals = len(spec.state), len(spec.goal)
    most = most_active(states, goals)
    if spec.budget > most:
        raise Invalid(
            f"budget must be at most {most} with {states} states and {goals} goals, so that the model fits into a "
            f"message of {MAX_MESSAGE_BYTES} bytes; got {spec.budget}",
            details={"field": "budget", "most": most},
        )
