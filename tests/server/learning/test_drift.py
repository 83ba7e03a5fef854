"""A robot that changes, seen from outside: the restart of the outcome model is in the log."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np

from crkr.client import Client
from crkr.protocol import TaskSpec

J = np.array([[0.5, 0.2], [-0.1, 0.4]])


def specification() -> TaskSpec:
    axes = [{"name": name, "low": -1.0, "high": 1.0} for name in "xy"]
    outcome = [{"name": name, "tolerance": 0.05, "group": "miss"} for name in "ab"]
    return TaskSpec.from_dict({"name": "changing", "state": axes, "goal": axes, "outcome": outcome, "seed": 2})


def test_a_restart_of_the_outcome_model_is_told_and_survives_the_server(
    start_server: Callable[..., Any], tmp_path: Path
) -> None:
    server = start_server(data=tmp_path / "data")
    rng, probes = np.random.default_rng(3), np.random.default_rng(4).uniform(-0.5, 0.5, (20, 2))
    ids = [UUID(int=number) for number in range(20)]
    with Client(server.endpoint) as client:
        task = client.create_task(specification())
        for number in range(90):
            state, shift = rng.uniform(-0.5, 0.5, 2), 0.5 * (number >= 60)
            answer = task.predict(state, explore=True)
            off = 0.3 * state + J @ (answer.goal + shift)
            won = bool((np.abs(off) < 0.05).all())
            task.report(answer, cost=0.1, success=won, outcome=off, wait=True)
        status = task.status()
        drift, success = status["drift"], status["success"]
        assert drift["restarts"] == 1
        assert [advice["code"] for advice in status["advice"]] == ["drifted"]
        assert success["trials"] == 90
        before = [task.predict(probes, explore=explore, trial_ids=ids) for explore in (False, True)]
    server.process.kill()
    server.process.wait()
    with Client(start_server(data=tmp_path / "data").endpoint) as client:
        task = client.task("changing")
        again = task.status()
        assert {**again["drift"], "score": None} == {**drift, "score": None}
        assert (again["advice"], again["success"]) == (status["advice"], success)
        for explore, earlier in zip((False, True), before, strict=True):
            now = task.predict(probes, explore=explore, trial_ids=ids)
            for name in ("goals", "predicted_outcome", "predicted_outcome_sd", "success_probability"):
                np.testing.assert_allclose(getattr(now, name), getattr(earlier, name), rtol=0, atol=1e-9)
