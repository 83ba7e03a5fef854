"""The program for a robot without a network runs as it is printed."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crkr.client import Client

DOCUMENT = Path(__file__).parents[2] / "docs/offline.md"


def test_the_documented_program_runs_as_it_is_printed(
    start_server: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    [program] = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)  # where its outbox comes to lie
    endpoint = start_server().endpoint
    with Client(endpoint) as client:
        state = [{"name": f"s{number}", "low": -6, "high": 6} for number in range(6)]
        goal = [{"name": "g", "low": -1, "high": 1}]
        task = client.create_task({"name": "table-tennis", "state": state, "goal": goal})
        task.report(state=np.zeros(6), goal=np.zeros(1), cost=0.1, success=True, wait=True)
        exec(compile(program.replace("tcp/127.0.0.1:7447", endpoint), str(DOCUMENT), "exec"), {})
        with task.outbox("trials.outbox") as outbox:
            outbox.flush(10.0)
        assert task.status()["samples"]["trial"] == 2
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("[")
    assert second.endswith("None")
