"""Outcomes that no sensor measures, and goals that tell nothing: answers stay goals."""

from __future__ import annotations

from collections.abc import Callable
from uuid import UUID

import numpy as np
import pytest

from crkr.learner import Learner
from crkr.protocol import Array, TaskSpec

MakeSpec = Callable[..., TaskSpec]

D, P = 2, 3
TARGET = np.array([0.5, -0.2])
STATES = np.random.default_rng(9).uniform(-0.6, 0.6, (40, D))

HOSTILE: dict[str, Callable[[np.random.Generator], Array]] = {
    "huge": lambda rng: rng.choice([-1e300, 1e300], (80, 2)),
    "at the ends of floats": lambda rng: rng.choice([-1.7e308, 1.7e308, 5e-324, -1e-310, 0.0], (80, 2)),
    "huge and small": lambda rng: 10.0 ** rng.uniform(-300, 300, (80, 2)),
    "one entry never seen": lambda rng: np.stack([rng.normal(size=80), np.full(80, np.nan)], axis=1),
    "never seen": lambda _: np.full((80, 2), np.nan),
    "constant": lambda _: np.tile([0.3, 0.7], (80, 1)),
    "the same twice": lambda rng: np.repeat(rng.choice([-1e3, 1e3, 0.0], (80, 1)), 2, axis=1) + TARGET,
    "on target": lambda _: np.tile(TARGET, (80, 1)),
}


@pytest.mark.parametrize("tolerance", [1e-300, 0.05, 1e300])
@pytest.mark.parametrize("outcomes", HOSTILE)
@pytest.mark.parametrize("goals", ["one", "several", "at the bounds", "hardly different"])
def test_no_outcome_makes_a_goal_that_is_not_a_number_within_the_bounds(
    make_spec: MakeSpec, outcomes: str, goals: str, tolerance: float
) -> None:
    rng = np.random.default_rng(0)
    entries = [
        {"name": name, "tolerance": tolerance, "target": target, "group": name}
        for name, target in zip("ab", TARGET, strict=True)
    ]
    learner = Learner(make_spec(D, P, outcome=entries, exploration={"type": "outcome", "min_trials": 10}))
    executed = {
        "one": np.zeros((80, P)),
        "several": rng.uniform(-1, 1, (80, P)),
        "at the bounds": rng.choice([-1.0, 1.0], (80, P)),
        "hardly different": rng.uniform(-1, 1, (80, P)) * 1e-148,
    }
    learner.report(
        state=rng.uniform(-2, 2, (80, D))
        * (rng.choice([0.0, 1.0, 1e150], (80, 1)) if goals != "hardly different" else 0),
        goal=executed[goals],
        cost=rng.uniform(size=80),
        success=True,
        outcome=HOSTILE[outcomes](rng),
    )
    states = np.concatenate([STATES, 1e8 * STATES, 1e300 * STATES, 1e308 * STATES, 5e-324 * STATES, np.zeros((1, D))])
    ids = [UUID(int=number) for number in range(len(states))]
    for explore in (False, True):
        chosen = learner.predict(states, explore, ids).goals
        assert (np.abs(chosen) <= 1.0).all()
