from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from crkr.protocol import TaskSpec

MakeSpec = Callable[..., TaskSpec]


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
