"""Checks a skill before a run: interface, shapes, ranges, repeatability, smoothness of outcomes, failures.

A state, a goal and an outcome have d, p and q numbers. A trial's numbers are its cost and its outcome.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Final, final

import numpy as np

from crkr.protocol import MAX_TELEMETRY_BYTES, Array, Geom, TaskSpec, pack
from crkr.sim_worker.guarded_skill import MOST_FAULTS, GuardedSkill, SkillFault
from crkr.sim_worker.skill import Skill, TrialResult
from crkr.sim_worker.worker.telemetry import thinned

__all__ = ["Remark", "check", "problems"]

_STATES: Final = 40  # states drawn, and goals tried
_MARGIN: Final = 0.05  # share of a state's box that samples rarely reach
_STEPS: Final = 12  # pairs of neighbouring goals
_STEP: Final = 0.01  # of the bounds, between neighbours
_ROUGH: Final = 0.25  # share of an outcome's spread by which neighbours may differ
_SHOWN: Final = 3  # demonstrations that are tried again
_DRAWN: Final = 20  # goals of which one must have a motion, if there is a scene


@final
@dataclass(frozen=True, slots=True)
class Remark:
    """One finding.

    Attributes:
        level: "ok", "warning" (it learns less well) or "problem" (it violates its contract).
        what: The part of the skill.
        message: The finding, and for a warning or problem what to do.
    """

    level: str
    what: str
    message: str

    def __str__(self) -> str:
        return f"{self.level:<8} {self.what}: {self.message}"


def problems(skill: Skill, *, seed: int = 0) -> list[str]:
    """Violations of the contract of `Skill`; empty if there are none, for a user's own test."""
    return [str(one) for one in check(skill, seed=seed) if one.level == "problem"]


def check(
    skill: Skill, *, seed: int = 0, within: Callable[[str], AbstractContextManager[object]] = lambda _: nullcontext()
) -> Iterator[Remark]:
    """Checks a skill with some 150 random situations and goals.

    Args:
        skill: What `load_skill` or your factory makes.
        seed: Of the situations and goals.
        within: Returns the context in which a method of the skill, given by name, is called.
    """
    guarded = GuardedSkill(skill, within)
    try:
        spec = guarded.spec()
        yield Remark("ok", "spec", f"{spec.name}: R^{len(spec.state)} -> R^{len(spec.goal)}, {_measures(spec)}")
        yield from _situations(guarded, spec, seed)
        yield from _trials(guarded, spec, seed)
        yield from _neighbours(guarded, spec, seed)
        yield from _pictures(guarded, spec, seed)
        yield from _demonstrations(guarded, seed)
    except SkillFault as fault:
        yield Remark("problem", "contract", fault.message)


def _measures(spec: TaskSpec) -> str:
    names = ", ".join(entry.name for entry in spec.outcome)
    return f"outcome {names}" if names else "no outcome: only successes teach"


def _situations(skill: GuardedSkill, spec: TaskSpec, seed: int) -> Iterator[Remark]:
    """Checks that states (40, d) are in their box, different, and the same for the same seed."""
    rng = np.random.default_rng(seed)
    states = np.array([skill.reset(rng).copy() for _ in range(_STATES)])
    again = np.random.default_rng(seed)
    repeated = np.array([skill.reset(again).copy() for _ in range(3)])
    if not np.array_equal(states[:3], repeated):
        yield Remark("warning", "reset", "the same rng gives another state; draw from it alone, so that runs repeat")
    low, high = (np.array([getattr(axis, end) for axis in spec.state]) for end in ("low", "high"))
    for axis, column, least, most in zip(spec.state, states.T, low, high, strict=True):
        margin = _MARGIN * (most - least)
        outside = int(np.count_nonzero((column < least - margin) | (column > most + margin)))
        if outside:
            yield Remark("warning", "reset", f"{axis.name} leaves its box in {outside} of {_STATES} states; widen it")
        if len(np.unique(column)) == 1:
            yield Remark("warning", "reset", f"{axis.name} is {column[0]:g} in all states; leave it out of the state")
        elif np.ptp(column) < 0.1 * (most - least):
            used = f"{np.ptp(column):.3g} of {most - least:.3g}"
            yield Remark("warning", "reset", f"{axis.name} uses {used} of its box; narrow it, as scales follow it")
    yield Remark("ok", "reset", f"{_STATES} states of {len(spec.state)} numbers")


def _trials(skill: GuardedSkill, spec: TaskSpec, seed: int) -> Iterator[Remark]:
    """Tries goals all over their bounds: results, failures and times."""
    rng, (low, high) = np.random.default_rng((seed, 1)), spec.bounds
    goals = [low, high, (low + high) / 2, *rng.uniform(low, high, (_STATES - 3, len(low)))]
    results: list[TrialResult] = []
    started = time.monotonic()
    for goal in goals:
        skill.reset(rng)
        results.append(_tried(skill, goal))
    each_ms = 1e3 * (time.monotonic() - started) / len(goals)
    faults = Counter(str(one.info["error"]) for one in results if "error" in one.info)
    for error, count in faults.most_common(3):
        yield Remark(
            "problem",
            "execute",
            f"{error}, {count} of {len(goals)} times; in a run that is a failed trial, and {MOST_FAULTS} in a row end "
            "the worker: return TrialResult(None, False, False, info={'reason': ...}) for a goal that cannot be tried",
        )
    executed = [one for one in results if one.executed]
    refused = Counter(str(one.info.get("reason", "no reason")) for one in results if not one.executed)
    if refused and not faults:
        told = ", ".join(f"{reason} {count}" for reason, count in refused.most_common(3))
        few = len(executed) >= 2 / 3 * len(goals)
        advice = "" if few else "; narrow the goal's bounds to what can be tried"
        told = f"{sum(refused.values())} of {len(goals)} random goals are refused: {told}{advice}"
        yield Remark("ok" if few else "warning", "execute", told)
    if executed:
        hits = sum(one.success for one in executed)
        yield Remark("ok", "execute", f"{len(executed)} trials, {hits} of them successes, {each_ms:.1f} ms each")
        yield from _costs(np.array([one.cost for one in executed], dtype=np.float64), spec)
        yield from _outcomes(executed, spec)
    yield from _repetition(skill, spec, seed)


def _costs(costs: Array, spec: TaskSpec) -> Iterator[Remark]:
    if spec.cost == "label":
        return
    saturated = float(np.mean(costs >= 0.999))
    if np.ptp(costs) == 0:
        yield Remark("warning", "cost", f"is {costs[0]:g} in all trials; it must say which of two trials was better")
    elif saturated > 0.5:
        yield Remark(
            "warning",
            "cost",
            f"is 1 in {saturated:.0%} of random trials, which look alike then; 1 - exp(-miss / scale)",
        )
    if (costs == 0).any():
        yield Remark("warning", "cost", "is 0 at times, which means certain; let a hit cost 0.1 unless it is measured")


def _outcomes(executed: list[TrialResult], spec: TaskSpec) -> Iterator[Remark]:
    if not spec.outcome:
        return
    absent = np.full(len(spec.outcome), np.nan)
    measured = np.array([absent if one.outcome is None else one.outcome for one in executed])
    for entry, column in zip(spec.outcome, measured.T, strict=True):
        seen = column[~np.isnan(column)]
        if not len(seen):
            yield Remark("warning", "outcome", f"{entry.name} is never observed in random trials, so it guides none")
        elif np.ptp(seen) == 0 and len(seen) > 1:
            yield Remark("warning", "outcome", f"{entry.name} is {seen[0]:g} in all trials; measure a signed distance")
        elif (seen >= 0).all() and entry.target == 0 and entry.aim == "equal" and len(seen) > 10:
            yield Remark("warning", "outcome", f"{entry.name} is never negative; a sign says which way to correct")


def _repetition(skill: GuardedSkill, spec: TaskSpec, seed: int) -> Iterator[Remark]:
    """Tries the same situation and goal twice: noise, in tolerances."""
    goals = np.random.default_rng((seed, 2)).uniform(*spec.bounds, (5, len(spec.goal)))
    worst, varies = 0.0, False
    tolerances = np.array([entry.tolerance for entry in spec.outcome])
    for number, goal in enumerate(goals):
        twice = []
        for _ in range(2):
            skill.reset(np.random.default_rng((seed, 3, number)))
            twice.append(_tried(skill, goal))
        one, other = twice
        varies |= (one.cost, one.success, one.executed) != (other.cost, other.success, other.executed)
        if one.outcome is not None and other.outcome is not None and len(tolerances):
            off = np.abs(one.outcome - other.outcome) / tolerances
            worst = max(worst, float(np.nanmax(off, initial=0.0)))
    if worst > 1:
        yield Remark(
            "warning",
            "execute",
            f"repeated trials differ by up to {worst:.1f} tolerances; measure better, or raise them",
        )
    elif varies or worst:
        yield Remark("ok", "execute", f"repeated trials differ a little ({worst:.2g} tolerances), as on a real robot")
    else:
        yield Remark("ok", "execute", "repeated trials are equal")


def _neighbours(skill: GuardedSkill, spec: TaskSpec, seed: int) -> Iterator[Remark]:
    """Compares trials of goals that are a hundredth of the bounds apart."""
    rng, (low, high) = np.random.default_rng((seed, 4)), spec.bounds
    before, after = list[Array](), list[Array]()
    for number in range(_STEPS):
        goal = rng.uniform(low, high)
        direction = rng.normal(size=len(low))
        step = _STEP * (high - low) * direction / np.linalg.norm(direction)
        for found, tried in ((before, goal), (after, np.clip(goal + step, low, high))):
            skill.reset(np.random.default_rng((seed, 5, number)))
            found.append(_numbers(_tried(skill, tried), spec))
    first, second = np.array(before), np.array(after)
    names = ["cost", *(entry.name for entry in spec.outcome)]
    for name, one, other in zip(names, first.T, second.T, strict=True):
        both = ~(np.isnan(one) | np.isnan(other))
        spread = float(np.ptp(np.concatenate([one[both], other[both]]))) if both.sum() > 3 else 0.0
        if spread <= 0:
            continue
        jump = float(np.median(np.abs(one[both] - other[both]))) / spread
        if jump > _ROUGH and name != "cost":
            yield Remark(
                "warning",
                "outcome",
                f"{name} jumps by {jump:.0%} of its spread between goals 1 % apart; measure what changes smoothly, or "
                "choose goals that do",
            )
        elif name != "cost":
            yield Remark("ok", "outcome", f"{name} changes by {jump:.1%} of its spread between goals 1 % apart")


def _numbers(result: TrialResult, spec: TaskSpec) -> Array:
    """(1 + q,) the cost and the outcome, NaN if missing."""
    outcome = np.full(len(spec.outcome), np.nan) if result.outcome is None else result.outcome
    return np.array([np.nan if result.cost is None else result.cost, *outcome])


def _pictures(guarded: GuardedSkill, spec: TaskSpec, seed: int) -> Iterator[Remark]:
    """The scene, and whether a trace fits it."""
    shapes = guarded.shapes()
    if shapes is None:
        yield Remark("problem", "scene", "cannot be drawn; it must return a list of Geom")
        return
    if not shapes:
        yield Remark("ok", "scene", "none: displays show no shapes")
        return
    rng, (low, high) = np.random.default_rng((seed, 6)), spec.bounds
    trace = None
    for goal in ((low + high) / 2, *rng.uniform(low, high, (_DRAWN, len(low)))):
        guarded.reset(rng)
        trace = _tried(guarded, goal).trace
        if trace is not None:
            break
    else:
        yield Remark("warning", "trace", f"none for any of {_DRAWN + 1} goals: displays show no motion")
        return
    yield from _bodies(shapes, trace.bodies)
    count = len(trace.time), len(trace.bodies)
    for name, shape in {"positions": (*count, 3), "quaternions": (*count, 4)}.items():
        if (found := np.shape(getattr(trace, name))) != shape:
            yield Remark("problem", "trace", f"{name} must have shape {shape}; got {found}")
            return
    size = len(pack(thinned(trace).to_wire()))
    if size > MAX_TELEMETRY_BYTES:
        yield Remark("warning", "trace", f"has {size} bytes, displays get {MAX_TELEMETRY_BYTES}; give fewer points")
    yield Remark("ok", "scene", f"{len(shapes)} shapes, {len(trace.bodies)} bodies move, {len(trace.time)} poses")


def _bodies(shapes: Iterable[Geom], moving: tuple[str, ...]) -> Iterator[Remark]:
    drawn = {shape.body for shape in shapes} - {"world"}
    if still := sorted(drawn - set(moving)):
        yield Remark("warning", "trace", f"has no poses for {', '.join(still)}, which the scene has")
    if unseen := sorted(set(moving) - drawn):
        yield Remark("warning", "scene", f"has no shapes for {', '.join(unseen)}, which the trace moves")


def _demonstrations(skill: GuardedSkill, seed: int) -> Iterator[Remark]:
    if not skill.can_demonstrate:
        yield Remark("ok", "demonstrations", "none: the first goals fill the space between the bounds")
        return
    shown = skill.demonstrations(_SHOWN, np.random.default_rng((seed, 7)))
    failed = sum(not one.result.success for one in shown)
    level = "warning" if failed else "ok"
    yield Remark(level, "demonstrations", f"{len(shown)} shown" + (f", {failed} of them no success" if failed else ""))


def _tried(skill: GuardedSkill, goal: Array) -> TrialResult:
    """The result of a goal; ten failures in a row are reported like the last one."""
    try:
        return skill.execute(goal)
    except SkillFault as fault:
        return TrialResult(None, False, False, info={"reason": "error", "error": fault.message})
