from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]  # it has no annotations

from crkr.protocol import TaskSpec

MakeSpec = Callable[..., TaskSpec]


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
