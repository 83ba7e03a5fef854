"""The programs of the documents for Python run as they are printed."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import RunningServer

from crkr.client import Client

DOCUMENTS = Path(__file__).parents[2] / "docs"
ENDPOINT = "tcp/127.0.0.1:7447"  # the default, which another server may hold while this runs


def run_program(document: str, endpoint: str) -> None:
    """All blocks of a document one after another, as in one session."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCUMENTS / document).read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(compile(block.replace(ENDPOINT, endpoint), document, "exec"), names)


def test_a_robot_goes_on_without_a_network(
    start_server: Callable[..., Any],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # where its outbox comes to lie
    endpoint = start_server().endpoint
    with Client(endpoint) as client:
        state = [{"name": f"s{number}", "low": -6, "high": 6} for number in range(6)]
        goal = [{"name": "g", "low": -1, "high": 1}]
        task = client.create_task({"name": "table-tennis", "state": state, "goal": goal})
        task.report(state=np.zeros(6), goal=np.zeros(1), cost=0.1, success=True, wait=True)
        run_program("offline.md", endpoint)
        with task.outbox("trials.outbox") as outbox:
            outbox.flush(10.0)
        assert task.status()["samples"]["trial"] == 2
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("[")
    assert second.endswith("None")


def test_the_three_ways_from_python(server: RunningServer, capsys: pytest.CaptureFixture[str]) -> None:
    run_program("python.md", server.endpoint)
    samples, notice, learned = capsys.readouterr().out.splitlines()
    assert samples == "{'trial': 3, 'demonstration': 0, 'evaluation': 0, 'failed': 0}"
    topic, version, active = notice.split()
    assert (topic, int(version) >= 3, int(active) >= 2) == ("model", True, True)
    speed, angle = (float(number) for number in learned[1 : learned.index("]")].split())
    assert abs(speed**2 * np.sin(2 * angle) / 9.81 - 2.0) < 0.8, "it learned to throw"
