"""A long task is learned by the compiled selection, and without numba as before: the same model either way."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import Processes

from crkr.protocol import TaskSpec
from crkr.server.inspection.synthetic_log import fill
from crkr.server.learning.acceleration import LONG

Ask = Callable[..., dict[str, Any]]
# What Python runs first in every process: one in which numba is not installed.
WITHOUT_NUMBA = """
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] == "numba":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
"""


@pytest.mark.timeout(1200)
def test_the_compiled_selection_takes_over_and_is_not_missed_where_numba_is_missing(
    tmp_path: Path,
    start_server: Callable[..., Any],
    connect: Callable[[str], Ask],
    make_trial: Callable[..., dict[str, Any]],
    reach: dict[str, Any],
    processes: Processes,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compiled = [sys.executable, "-c", "from crkr.learner import accelerate; accelerate()"]
    subprocess.run(compiled, check=True, timeout=900)  # so that what follows is quick on a busy machine too
    data = tmp_path / "data"
    fill(data, TaskSpec.from_dict(reach), LONG)
    server = start_server(data=data)
    ask = connect(server.endpoint)

    def learn(first: int) -> None:
        for number in range(first, first + 20):
            ask("task/reach/rpc/report", {"trials": [make_trial(number, cost=number % 7 / 1000)], "wait": True})

    learn(100_000)
    processes.wait_until(lambda: "the compiled selection is loaded" in server.log.read_text(), server.log)
    learn(200_000)
    learned = ask("task/reach/rpc/model")
    server.process.kill()
    server.process.wait()
    (tmp_path / "without").mkdir()
    (tmp_path / "without" / "sitecustomize.py").write_text(WITHOUT_NUMBA)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "without"))
    other = start_server(data=data)
    ask = connect(other.endpoint)
    again = ask("task/reach/rpc/model")
    assert {**again, "server_id": None} == {**learned, "server_id": None}
    learn(300_000)
    assert "pip install 'crkr[fast]'" in other.log.read_text()
