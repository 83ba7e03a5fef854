"""What a task that learns from outcomes promises, held by the learner in process and by a live server alike."""

from typing import Any
from uuid import UUID, uuid4

import numpy as np

from crkr.client import Client
from crkr.learner import Learner
from crkr.protocol import Prediction, TaskSpec

SLOPE = np.array([[1.0, 0.5, 0.0], [0.0, -0.5, 1.0]])


def specification() -> TaskSpec:
    outcome = [{"name": name, "unit": "m", "target": 0.1, "tolerance": 0.05, "group": name} for name in ("side", "far")]
    return TaskSpec.from_dict(
        {
            "name": f"aim-{uuid4()}",
            "state": [{"name": name, "low": -1, "high": 1} for name in "xy"],
            "goal": [{"name": name, "low": -2, "high": 2} for name in "ghi"],
            "outcome": outcome,
            "seed": 3,
        }
    )


def tried(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """Trials of a world that is a line; the second number is seen in two of three."""
    states, goals = rng.uniform(-1, 1, (count, 2)), rng.uniform(-1, 1, (count, 3))
    outcomes = states + goals @ SLOPE.T
    outcomes[rng.uniform(size=count) < 0.3, 1] = np.nan
    return {
        "state": states,
        "goal": goals,
        "cost": rng.uniform(0.1, 1, count),
        "success": [bool(lucky) for lucky in rng.uniform(size=count) < 0.3],
        "outcome": outcomes,
        "id": [UUID(bytes=rng.bytes(16)) for _ in range(count)],
    }


def test_both_are_guided_alike_after_any_history(client: Client) -> None:
    spec = specification()
    local, remote = Learner(spec), client.create_task(spec)
    rng = np.random.default_rng(4)
    probes = rng.uniform(-1, 1, (12, 2))
    draws = [UUID(bytes=rng.bytes(16)) for _ in probes]
    policies = set()
    for step in range(8):
        trials = tried(rng, 12)
        kind = "demonstration" if step == 0 else "evaluation" if step == 3 else "trial"
        local.report(**trials, kind=kind)
        remote.report(**trials, kind=kind, wait=True)
        if step == 5:
            local.remove(trials["id"][:4])
            remote.remove(trials["id"][:4])
        for explore in (False, True):
            mine = local.predict(probes, explore, draws)
            check_alike(mine, remote.predict(probes, explore, trial_ids=draws))
            policies.add(mine.policy)
            for row in (0, 7):
                one = local.predict(probes[row], explore, draws[row])
                check_alike(one, remote.predict(probes[row], explore, trial_ids=[draws[row]]))
    assert policies == {"corrected", "explore"}


def check_alike(mine: Prediction, theirs: Prediction) -> None:
    assert (mine.model_version, mine.active, mine.policy) == (theirs.model_version, theirs.active, theirs.policy)
    for name in ("goals", "means", "sigmas", "novelty", "success_probability"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=0, atol=1e-9)
    for name in ("predicted_outcome", "predicted_outcome_sd"):
        near, far = getattr(mine, name), getattr(theirs, name)
        assert (near is None) == (far is None)
        if near is not None:
            np.testing.assert_allclose(near, far, rtol=0, atol=1e-9)
            assert near.shape == (*mine.goals.shape[:-1], 2)


def test_a_corrected_goal_hits_where_the_mean_misses(client: Client) -> None:
    spec = specification()
    local, remote = Learner(spec), client.create_task(spec)
    trials = tried(np.random.default_rng(5), 300)
    local.report(**trials)
    remote.report(**trials, wait=True)
    states = np.random.default_rng(6).uniform(-0.7, 0.7, (50, 2))
    for answer in (local.predict(states), remote.predict(states)):
        assert answer.policy == "corrected"
        missed = np.abs(states + answer.means @ SLOPE.T - 0.1).max(axis=1)
        left = np.abs(states + answer.goals @ SLOPE.T - 0.1).max(axis=1)
        assert (missed > 0.2).sum() > 25
        assert left.max() < 0.13
        assert answer.predicted_outcome is not None
        np.testing.assert_allclose(answer.predicted_outcome, states + answer.goals @ SLOPE.T, atol=0.02)
