"""Learner, task, awaited task and outbox lead to the same policy, whatever was reported."""

from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from policies import REFUSED, Fields, LearnedPolicy, RemotePolicy, specification

from crkr.client import Client
from crkr.learner import Learner
from crkr.protocol import (
    Invalid,
)


@pytest.mark.parametrize(
    "settings", [{}, {"budget": 12, "cost_map": "odds", "learn_from": "all", "regularisation": 0.3}]
)
def test_both_answer_alike_after_any_history(client: Client, settings: dict[str, Any]) -> None:
    spec = specification(**settings)
    local, remote = Learner(spec), RemotePolicy(client.create_task(spec))
    rng = np.random.default_rng(4)
    probes = rng.uniform(-0.5, 2.5, (25, 2))
    draws = [UUID(bytes=rng.bytes(16)) for _ in probes]
    ids: list[UUID] = []
    for step in range(12):
        fresh = [UUID(bytes=rng.bytes(16)) for _ in range(8)]
        trials: Fields = {
            "state": rng.uniform([0, -1], [2, 1], (8, 2)),
            "goal": rng.uniform([-1, 0, 0], [2, 1, 9], (8, 3)),
            "cost": rng.uniform(0, 1, 8),
            "success": [bool(flag) for flag in rng.uniform(size=8) < 0.6],
            "kind": "demonstration" if step == 0 else "trial",
            "id": fresh,
        }
        victims = [ids[index] for index in rng.choice(len(ids), 3, replace=False)] if ids else []
        ids += fresh
        both: list[LearnedPolicy] = [local, remote]
        for policy in both:
            policy.report(**trials)
            if victims and step % 3 == 1:
                policy.recost(victims, [0.0, 0.5, 1.0])
            if victims and step % 3 == 2:
                policy.remove(victims[:1])
                ids = [known for known in ids if known != victims[0]] if policy is remote else ids
            if step == 7:
                policy.configure({"budget": 15, "explore_scale": 0.5, "kernel": {"linear_weight": 0.2}})
        assert local.active_ids == remote.active_ids
        for explore in (False, True):
            mine, theirs = (policy.predict(probes, explore, trial_ids=draws) for policy in both)
            assert (mine.model_version, mine.active, mine.policy) == (
                theirs.model_version, theirs.active, theirs.policy,
            )  # fmt: skip
            for name in ("goals", "means", "sigmas", "novelty"):
                np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), rtol=0, atol=1e-9)
        near, far = (policy.explain(probes[0], ids[-1]) for policy in both)
        assert near.sample == far.sample
        assert [neighbour.id for neighbour in near.neighbours] == [neighbour.id for neighbour in far.neighbours]


def test_trials_of_an_outbox_are_learned_from_as_if_they_were_reported(client: Client, tmp_path: Path) -> None:
    spec = specification()
    local, task = Learner(spec), client.create_task(spec)
    rng = np.random.default_rng(6)
    with task.outbox(tmp_path / "box") as outbox:
        for count in (1, 7, 20):
            trials: Fields = {
                "state": rng.uniform([0, -1], [2, 1], (count, 2)),
                "goal": rng.uniform([-1, 0, 0], [2, 1, 9], (count, 3)),
                "cost": rng.uniform(0, 1, count),
                "success": True,
                "id": [UUID(bytes=rng.bytes(16)) for _ in range(count)],
            }
            local.report(**trials)
            assert outbox.report(**trials) == tuple(trials["id"])
            assert outbox.report(**trials) == tuple(trials["id"])  # stored once all the same
        answered = local.predict([1.0, 0.0], True)
        trial: Fields = {"cost": 0.3, "success": True}
        local.report(answered, **trial)
        outbox.report(answered, **trial)
        outbox.flush(20.0)
        assert outbox.refused() == []
    remote = RemotePolicy(task)
    task.report(state=[1.0, 0.0], goal=[0.5, 0.5, 5.0], cost=None, success=False, kind="failed", wait=True)
    assert remote.active_ids == local.active_ids
    states = rng.uniform(0, 1, (9, 2))
    np.testing.assert_allclose(remote.predict(states).means, local.predict(states).means, rtol=0, atol=1e-9)


@pytest.mark.parametrize("arguments", [arguments for call, arguments in REFUSED if call == "report"])
def test_an_outbox_refuses_at_once_what_a_task_refuses(client: Client, tmp_path: Path, arguments: Fields) -> None:
    good: Fields = {"state": [1.0, 0.0], "goal": [0.5, 0.5, 5.0], "cost": 0.1, "success": True}
    with client.create_task(specification()).outbox(tmp_path / "box") as outbox:
        with pytest.raises(Invalid):
            outbox.report(**{**good, **arguments})
        assert outbox.pending == 0
