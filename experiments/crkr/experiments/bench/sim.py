"""What `crkr bench sim` measures: trials of a real run beside their bare minimum; throws beside strokes.

Both sides of a ratio are timed by the process's own clock, trial by trial in turns. `crkr` has numpy use one BLAS
thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from time import process_time
from typing import Final, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from crkr.experiments.bench.measurements import Measurement, ratio
from crkr.experiments.learning.run import Course, trained_learner
from crkr.protocol import Array
from crkr.sim_worker.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS, Arm, tracking_controls
from crkr.sim_worker.primitives.stroke import Infeasible, JointLimits, Primitive
from crkr.sim_worker.randomness import training_rng
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.environments.analytic_batch import AnalyticBatch
from crkr.sim_worker.table_tennis.environments.environments import ENVIRONMENTS
from crkr.sim_worker.table_tennis.environments.play import FOLLOW
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.scene import make_arm, make_simulation
from crkr.sim_worker.table_tennis.table_tennis import TableTennis
from crkr.sim_worker.throw import Throw

__all__ = ["Run", "environment_times", "measure", "measure_throw"]

Flags = NDArray[np.bool_]

_WARM: Final = 300  # trials before the measured ones: the active set is then full
_BATCH: Final = 3000  # trials of the analytic environment at once
_SHOWN: Final = 20  # planned strokes timed beside the throws
_LANDING: Final = slice(3, 5)  # entries of the outcome with the landing point
_THROWN: Final = slice(0, 2)  # the same of a throw


class Run(NamedTuple):
    """The measured part of a run in contact.

    Attributes:
        balls: (n, d) the states of the trials that moved the arm.
        goals: (n, p) the goals tried in them.
        all_goals: (m, p) all goals.
        learning_ms: Mean processor time of choosing a goal and learning from its result [ms].
    """

    balls: Array
    goals: Array
    all_goals: Array
    learning_ms: float


def measure(trials: int, seed: int) -> Iterator[Measurement]:
    """All figures, in turn, of `trials` trials of a run with a seed."""
    run = _training_run(TableTennis(SkillOptions(seed=seed), traces=False), trials, seed)
    ms = environment_times(run.balls, run.goals, _BATCH)
    whole = ms["contact"] + run.learning_ms
    behind = {"trial ms": whole, "of it learning": run.learning_ms, "bare steps ms": ms["bare"]}
    yield Measurement("a contact trial with learning / its bare steps", whole / ms["bare"], 1.4, False, behind)
    yield Measurement("contact trials a second", 1e3 / whole, None, True)
    yield ratio("a hybrid trial / a contact trial", ms, "hybrid", "contact", 0.55, unit="ms")
    behind = {"analytic us": 1e3 * ms["analytic"], "batched us": 1e3 * ms["batched"]}
    what = f"analytic trials a second, {_BATCH} at once / one by one"
    yield Measurement(what, ms["analytic"] / ms["batched"], 100.0, True, behind)
    yield _swings(run.all_goals)
    yield from _agreement(run)


def measure_throw(trials: int, seed: int) -> Iterator[Measurement]:
    """All figures, in turn, of `trials` throws of a run with a seed."""
    throws, strokes = Throw(SkillOptions(seed=seed), traces=False), TableTennis(SkillOptions(), traces=False)
    exact = Throw(SkillOptions(environment="analytic"), traces=False)
    run = _training_run(throws, trials, seed)
    shown = strokes.demonstrations(_SHOWN, np.random.default_rng(seed))
    ms = dict.fromkeys(("throw", "analytic throw", "stroke"), 0.0)
    for place, (state, goal) in enumerate(zip(run.balls, run.goals, strict=True)):
        other = shown[place % len(shown)]
        calls = {
            "throw": partial(throws.attempt, state, goal),
            "analytic throw": partial(exact.attempt, state, goal),
            "stroke": partial(strokes.attempt, other.state, other.goal),
        }
        for name, call in calls.items():
            ms[name] += 1e3 * _timed(call) / len(run.goals)
    yield ratio("a contact trial of the throw / of table tennis", ms, "throw", "stroke", 1.0, unit="ms")
    yield ratio("an analytic throw / a contact one", ms, "analytic throw", "throw", unit="ms")
    yield _agreed("contact", *_verdicts(throws, run, _THROWN), *_verdicts(exact, run, _THROWN))


def environment_times(balls: Array, goals: Array, batch: int) -> dict[str, float]:
    """Mean processor times of the same trials [ms]: by environment, "batched" analytic ones, and "bare" contact steps.

    Args:
        balls: (n, 6) as measured.
        goals: (n, 13) for them, which all move the arm.
        batch: Size of the batch, which repeats them.
    """
    skills = {name: TableTennis(SkillOptions(environment=name), traces=False) for name in ENVIRONMENTS}
    spent = dict.fromkeys([*ENVIRONMENTS, "bare"], 0.0)
    bare = _BareSteps()
    for skill in skills.values():
        skill.attempt(balls[0], goals[0])  # untimed
    for ball, goal in zip(balls, goals, strict=True):
        for name, skill in skills.items():
            spent[name] += _timed(partial(skill.attempt, ball, goal))
        spent["bare"] += bare.timed(ball, goal)
    rows = np.resize(np.arange(len(balls)), batch)
    many = AnalyticBatch(make_arm())
    many.play(balls[rows], goals[rows])  # untimed
    batched = 1e3 * _timed(lambda: many.play(balls[rows], goals[rows])) / batch
    return {name: 1e3 * total / len(balls) for name, total in spent.items()} | {"batched": batched}


def _limits(arm: Arm) -> JointLimits:
    return JointLimits(arm.lower, arm.upper, SPEED_LIMITS, ACCELERATION_LIMITS)


@final
class _BareSteps:
    """The contact simulation of a goal, everything else prepared."""

    def __init__(self) -> None:
        self._arm, self._simulation = make_arm(), make_simulation()
        self._primitive = Primitive(_limits(self._arm))

    def timed(self, ball: Array, goal: Array) -> float:
        """Processor time of the simulation's steps [s]."""
        hit_time = float(goal[12])
        swing = self._primitive.trajectory(HOME, goal[:6], goal[6:12], hit_time)
        step = self._simulation.timestep
        times = np.arange(int(np.ceil((hit_time + FOLLOW) / step)), dtype=np.float64) * step
        controls = tracking_controls(self._arm, self._simulation.gains, swing, times)
        start = self._simulation.start(HOME, ball)
        return _timed(lambda: self._simulation.run(start, controls))


def _timed(call: Callable[[], object]) -> float:
    """Processor time of a call [s]."""
    begin = process_time()
    call()
    return process_time() - begin


def _swings(goals: Array) -> Measurement:
    """The motion primitive beside Clarabel for every joint; a goal that is refused takes its time too."""
    limits = _limits(make_arm())
    both = {"swing": Primitive(limits), "Clarabel": Primitive(limits, shortcuts=False)}
    ms = dict.fromkeys(both, 0.0)

    def attempt(primitive: Primitive, goal: Array) -> None:
        with suppress(Infeasible):
            primitive.trajectory(HOME, goal[:6], goal[6:12], float(goal[12]))

    for primitive in both.values():
        attempt(primitive, goals[0])  # untimed
    for goal in goals:
        for name, primitive in both.items():
            ms[name] += 1e3 / len(goals) * _timed(partial(attempt, primitive, goal))
    return ratio("a swing / Clarabel alone on the same goals", ms, "swing", "Clarabel", 0.15, unit="ms")


def _agreement(run: Run) -> Iterator[Measurement]:
    """How often the other environments judge a trial as the analytic one does, and how far apart they land."""
    exact, landed = _verdicts(TableTennis(SkillOptions(environment="analytic"), traces=False), run, _LANDING)
    for name in ENVIRONMENTS:
        if name != "analytic":
            found = _verdicts(TableTennis(SkillOptions(environment=name), traces=False), run, _LANDING)
            yield _agreed(name, *found, exact, landed)
    batched = AnalyticBatch(make_arm()).play(run.balls, run.goals).strict
    yield _agreed("analytic, batched", batched, np.full_like(landed, np.nan), exact, landed)


def _verdicts(skill: TableTennis | Throw, run: Run, landing: slice) -> tuple[Flags, Array]:
    """Success (n,) of a run's trials in a skill's environment, and landing points (n, 2) [m], NaN: none.

    Args:
        skill: Executes.
        run: Its trials.
        landing: Entries of the outcome with the landing point.
    """
    results = [skill.attempt(state, goal) for state, goal in zip(run.balls, run.goals, strict=True)]
    landings = [np.full(2, np.nan) if one.outcome is None else one.outcome[landing] for one in results]
    return np.array([one.success for one in results]), np.array(landings)


def _agreed(name: str, success: Flags, landings: Array, exact: Flags, landed: Array) -> Measurement:
    """How often an environment judges as the analytic one does, and how far apart they land.

    Args:
        name: Of the environment.
        success: (n,) there.
        landings: (n, 2) there [m].
        exact: (n,) success in the analytic one.
        landed: (n, 2) there [m].
    """
    apart = np.linalg.norm(landings - landed, axis=1)
    apart = apart[~np.isnan(apart)]
    behind = {"landings apart, median m": float(np.median(apart))} if apart.size else {}
    return Measurement(f"same strict verdict as analytic: {name}", float((success == exact).mean()), None, True, behind)


def _training_run(skill: TableTennis | Throw, trials: int, seed: int) -> Run:
    """Trials of a skill after the first 300 of a run."""
    learner = trained_learner(skill, Course(_WARM, 0, 0, 5), seed, lambda _: None)
    rng, balls, goals, executed, spent = training_rng(seed, 2), [], [], [], 0.0
    for _ in range(trials):
        ball = skill.reset(rng)
        begin = process_time()
        answer = learner.predict(ball, explore=True)
        chosen = process_time()
        result = skill.execute(answer.goals)
        played = process_time()
        kind = "trial" if result.executed else "failed"
        learner.report(answer, cost=result.cost, success=result.success, kind=kind, outcome=result.outcome)
        spent += chosen - begin + process_time() - played
        balls.append(ball)
        goals.append(answer.goals)
        executed.append(result.executed)
    moved = np.array(executed)
    return Run(np.array(balls)[moved], np.array(goals)[moved], np.array(goals), 1e3 * spent / trials)
