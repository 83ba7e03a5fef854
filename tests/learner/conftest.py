from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # it has no annotations

from crkr.learner import Learner
from crkr.protocol import TaskSpec, demonstration_id

MakeSpec = Callable[..., TaskSpec]
Teach = Callable[..., Learner]
Look = Callable[[Learner], tuple[Any, ...]]


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread() -> Iterator[None]:
    """Small matrices on a busy machine: a second thread only waits."""
    with threadpool_limits(1):
        yield


@pytest.fixture
def make_spec() -> MakeSpec:
    def make(d: int = 2, p: int = 2, **fields: Any) -> TaskSpec:
        return TaskSpec.from_dict(
            {
                "name": "reach",
                "state": [{"name": f"s{i}", "low": -2.0, "high": 2.0} for i in range(d)],
                "goal": [{"name": f"g{i}", "low": -1.0, "high": 1.0} for i in range(p)],
                **fields,
            }
        )

    return make


@pytest.fixture
def taught() -> Callable[..., Learner]:
    def teach(spec: TaskSpec, count: int = 60, seed: int = 0) -> Learner:
        """A learner with five demonstrations and a stream of trials, half of them successes."""
        rng = np.random.default_rng(seed)
        learner = Learner(spec)
        d, p = len(spec.state), len(spec.goal)
        demonstrations = [demonstration_id(spec.name, index) for index in range(5)]
        learner.report(
            state=rng.uniform(-2, 2, (5, d)),
            goal=rng.uniform(-0.5, 0.5, (5, p)),
            cost=np.zeros(5),
            success=True,
            kind="demonstration",
            id=demonstrations,
        )
        for number in range(count):
            answer = learner.predict(rng.uniform(-2, 2, d), explore=True)
            learner.report(answer, cost=float(rng.uniform()), success=bool(number % 2))
        return learner

    return teach


@pytest.fixture
def fingerprint() -> Callable[[Learner], tuple[Any, ...]]:
    def look(learner: Learner) -> tuple[Any, ...]:
        """Everything a caller can see of a learner."""
        answer = learner.model.predict(np.linspace(-1, 1, 3 * len(learner.spec.state)).reshape(3, -1))
        return (
            learner.version,
            learner.spec,
            learner.active_ids,
            learner.counts,
            learner.eligible,
            answer.means.tobytes(),
            answer.sigmas.tobytes(),
        )

    return look
