"""The ROS 2 node serves predict and report to nodes of other processes, by way of a router of its own."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from processes import RunningServer

from crkr.client import Client

FOLDER = Path(__file__).parents[2] / "examples" / "ros2"

ASK = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from node import address, await_service, definition
from zenoh_ros2_sdk import ROS2ServiceClient
there = address(sys.argv[2])
predict = ROS2ServiceClient("/throw/predict", **definition("Predict"), **there)
report = ROS2ServiceClient("/throw/report", **definition("Report"), **there)
for service in (predict, report):
    await_service(service)
answer = predict.call(state=np.array([1.0, 2.0]), explore=True)
print(answer.ok, answer.error)
answer = predict.call(state=np.array([3.0]), explore=True)
trial = {"trial_id": answer.trial_id, "state": np.array([3.0]), "kind": "", "success": False}
trial |= {"outcome": np.array([np.nan])}
for cost, goal in ((0.5, answer.goal), (0.5, answer.goal), (0.9, answer.goal), (0.5, answer.goal + 100.0)):
    receipt = report.call(cost=cost, goal=goal, **trial)
    print(receipt.ok, receipt.seq, receipt.duplicate, receipt.error)
trial |= {"trial_id": np.arange(16, dtype=np.uint8), "kind": "failed", "outcome": np.zeros(0)}
print(report.call(cost=np.nan, goal=answer.goal, **trial).ok)
predict.close()
report.close()
"""


@pytest.fixture
def router(free_port: int) -> Iterator[str]:
    """HOST:PORT of what stands for rmw_zenohd."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["tcp/127.0.0.1:{free_port}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        yield f"127.0.0.1:{free_port}"


@pytest.fixture
def node(server: RunningServer, router: str) -> Iterator[str]:
    """The router of a node that serves the task throw."""
    command = [sys.executable, "-m", "crkr.client", "create", str(FOLDER / "throw.toml"), "--connect", server.endpoint]
    subprocess.run(command, check=True, capture_output=True, timeout=60)
    words = [str(FOLDER / "node.py"), "throw", "--connect", server.endpoint, "--router", router]
    with subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "serving task throw\n"
            yield router
        finally:
            process.terminate()
            assert process.wait(timeout=20) == 0


def python(*words: str) -> str:
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=25, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_robots_node_learns_to_throw(server: RunningServer, node: str) -> None:
    said = python(str(FOLDER / "robot.py"), "throw", "60", "--router", node)
    first, last = (int(word.rstrip("%,\n")) for word in said.split() if "%" in word)
    assert first < 80
    assert last >= 80
    with Client(server.endpoint) as client:
        trials = [stored.trial for stored in client.task("throw").iter_samples()]
    assert len(trials) == 60
    assert {trial.worker for trial in trials} == {"ros2"}
    assert all(trial.outcome is not None for trial in trials)


def test_what_cannot_be_done_is_said_and_what_comes_twice_is_stored_once(server: RunningServer, node: str) -> None:
    wrong, stored, again, other, outside, failed = python("-c", ASK, str(FOLDER), node).splitlines()
    assert wrong.startswith("False ")
    assert "state" in wrong
    assert stored.split() == ["True", "2", "False"]
    assert again.split() == ["True", "2", "True"]
    assert other.startswith("False 0 False ")
    assert outside.startswith("False 0 False ")
    assert failed == "True"
    with Client(server.endpoint) as client:
        assert client.task("throw").status()["samples"]["failed"] == 1


def test_the_readmes_program_is_python() -> None:
    text = (FOLDER / "README.md").read_text()
    compile(text.split("```python\n")[1].split("```")[0], "README.md", "exec")
