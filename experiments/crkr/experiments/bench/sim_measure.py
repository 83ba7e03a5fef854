"""What `crkr bench sim` measures: the trials of a real run, beside what they cannot do without.

Both sides of a ratio are timed by the process's own clock, goal by goal in turns, on one BLAS thread.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from time import process_time
from typing import Final, NamedTuple

import numpy as np

from crkr.experiments.bench.learn import Row
from crkr.learner import Learner
from crkr.sim_worker.primitives.bench_primitive import SwingGoal, bench_primitive
from crkr.sim_worker.primitives.stroke import Infeasible, JointLimits, Primitive
from crkr.sim_worker.randomness import demonstration_rng, training_rng
from crkr.sim_worker.skill import Floats, SkillOptions
from crkr.sim_worker.table_tennis.arm.dynamics import ACCELERATION_LIMITS, SPEED_LIMITS, Arm
from crkr.sim_worker.table_tennis.environments.analytic_batch import AnalyticBatch
from crkr.sim_worker.table_tennis.environments.bench_environments import bench_environments
from crkr.sim_worker.table_tennis.environments.environments import ENVIRONMENTS
from crkr.sim_worker.table_tennis.planner import HOME
from crkr.sim_worker.table_tennis.table_tennis import TableTennis

__all__ = ["Run", "measure", "training_run", "worst_violation"]

WARM: Final = 300  # trials before the measured ones: the active set is then full
HIT_KNOT: Final = 25


class Run(NamedTuple):
    """The measured part of a run in contact.

    Attributes:
        balls: (n, 6) all situations.
        goals: (n, 13) the goals tried in them.
        executed: (n,) which of them moved the arm.
        learning_ms: Mean processor time of choosing a goal and learning from its result [ms].
    """

    balls: Floats
    goals: Floats
    executed: np.ndarray
    learning_ms: float


def measure(trials: int, seed: int) -> Iterator[Row]:
    """All rows, in turn."""
    run = training_run(trials, seed)
    bench = bench_environments(run.balls[run.executed], run.goals[run.executed])
    whole = bench.contact_ms + run.learning_ms
    detail = {"trial ms": whole, "of it learning": run.learning_ms, "bare steps ms": bench.bare_ms}
    yield Row("a contact trial with learning / its bare steps", whole / bench.bare_ms, 1.4, False, detail)
    yield Row("contact trials a second", 1e3 / whole, None, True, {})
    detail = {"hybrid ms": bench.hybrid_ms, "contact ms": bench.contact_ms}
    yield Row("a hybrid trial / a contact trial", bench.hybrid_over_contact, 0.55, False, detail)
    detail = {"analytic us": 1e3 * bench.analytic_ms, "batched us": bench.batch_us}
    yield Row(f"analytic trials a second, {bench.batch} at once / one by one", bench.batch_speedup, 100.0, True, detail)
    yield from _swings(run)
    yield from _agreement(run)


def _agreement(run: Run) -> Iterator[Row]:
    """How the other environments judge the same trials as the exact one does."""
    balls, goals = run.balls[run.executed], run.goals[run.executed]
    verdicts = {}
    for name in ENVIRONMENTS:
        skill = TableTennis(SkillOptions(environment=name), traces=False)
        results = [skill.attempt(ball, goal) for ball, goal in zip(balls, goals, strict=True)]
        landings = np.array([np.full(2, np.nan) if r.outcome is None else r.outcome[3:5] for r in results])
        verdicts[name] = np.array([bool(r.info["outcomes"]["strict"]) for r in results]), landings
    exact, landed = verdicts.pop("analytic")
    verdicts["analytic, batched"] = AnalyticBatch(Arm()).play(balls, goals).strict, np.full_like(landed, np.nan)
    for name, (strict, landings) in verdicts.items():
        apart = np.linalg.norm(landings - landed, axis=1)
        apart = apart[~np.isnan(apart)]
        detail = {"landings apart, median m": float(np.median(apart))} if apart.size else {}
        yield Row(f"same strict verdict as analytic: {name}", float((strict == exact).mean()), None, True, detail)


def _swings(run: Run) -> Iterator[Row]:
    arm = Arm()
    limits = JointLimits(arm.lower, arm.upper, SPEED_LIMITS, ACCELERATION_LIMITS)
    goals = [SwingGoal(HOME, goal[:6], goal[6:12], float(goal[12])) for goal in run.goals]
    swings = bench_primitive(limits, goals)
    detail = {"swing ms": swings.primitive_ms, "Clarabel ms": swings.clarabel_ms}
    yield Row("a swing / Clarabel alone on the same goals", swings.ratio, 0.15, False, detail)
    detail = {"goals": float(swings.goals), "refused by both": float(swings.infeasible)}
    yield Row("goals that only one of them refuses", float(swings.disagreements), 0.0, False, detail)
    worst = worst_violation(limits, goals)
    yield Row("accepted swings: worst departure from goal or limits", worst, 1e-6, False, {})


def training_run(trials: int, seed: int) -> Run:
    """A run of the default skill, of which the last `trials` are timed."""
    skill = TableTennis(SkillOptions(seed=seed), traces=False)
    learner = Learner(skill.spec())
    for shown in skill.demonstrations(5, demonstration_rng(seed)):
        learner.report(
            state=shown.state, goal=shown.goal, cost=shown.result.cost, success=True, kind="demonstration",
            outcome=shown.result.outcome,
        )  # fmt: skip
    rng, balls, goals, executed, spent = training_rng(seed, 1), [], [], [], 0.0
    for trial in range(WARM + trials):
        ball = skill.reset(rng)
        begin = process_time()
        answer = learner.predict(ball, explore=True)
        chosen = process_time()
        result = skill.execute(answer.goals)
        played = process_time()
        kind = "trial" if result.executed else "failed"
        learner.report(answer, cost=result.cost, success=result.success, kind=kind, outcome=result.outcome)
        if trial >= WARM:
            spent += chosen - begin + process_time() - played
            balls.append(ball)
            goals.append(answer.goals)
            executed.append(result.executed)
    return Run(np.array(balls), np.array(goals), np.array(executed), 1e3 * spent / trials)


def worst_violation(limits: JointLimits, goals: Sequence[SwingGoal]) -> float:
    """The most by which an accepted swing misses its goal, its rest or a limit [rad, rad/s, rad/s^2]."""
    primitive, worst = Primitive(limits), 0.0
    for goal in goals:
        try:
            swing = primitive.trajectory(goal.start, goal.position, goal.velocity, goal.hit_time)
        except Infeasible:
            continue
        position, velocity, acceleration = swing.sample(np.linspace(0.0, swing.time[-1], 1000))
        wrong = (
            np.abs(swing.position[HIT_KNOT] - goal.position),
            np.abs(swing.velocity[HIT_KNOT] - goal.velocity),
            np.abs(swing.velocity[-1]),
            np.maximum(position - limits.upper, limits.lower - position),
            np.abs(velocity) - limits.speed,
            np.abs(acceleration) - limits.acceleration,
        )
        worst = max(worst, *(float(np.max(part)) for part in wrong))
    return worst
