"""Reports, administration, backups and kills, all at once: the log agrees with itself, and so does every copy."""

import random
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from processes import Processes

from crkr.client import Client
from crkr.protocol import Conflict, Invalid

Start = Callable[..., Any]
CHANGES: tuple[dict[str, Any], ...] = (
    {"budget": 5},
    {"budget": 30},
    {"learn_from": "all"},
    {"learn_from": "successes"},
    {"cost_map": "odds"},
    {"cost_map": "linear"},
    {"regularisation": 0.01},
    {"refit_every": 25},
)


class Crowd:
    """Clients that ask without pause until told to stop, each with a connection and a source of chance of its own."""

    def __init__(self, endpoint: str) -> None:
        self._endpoint = endpoint
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self.acknowledged: list[UUID] = []
        self.administered = 0
        self.failed: list[BaseException] = []

    def add(self, act: Callable[[Any, random.Random], None]) -> None:
        self._threads.append(threading.Thread(target=self._go_on, args=(act, len(self._threads))))
        self._threads[-1].start()

    def _go_on(self, act: Callable[[Any, random.Random], None], seed: int) -> None:
        chance = random.Random(seed)
        try:
            with Client(self._endpoint, timeout_s=30) as client:
                while not self._stop.is_set():
                    act(client.task("reach"), chance)
        except BaseException as error:  # told by the test's own thread
            self.failed.append(error)

    def report(self, task: Any, chance: random.Random) -> None:
        identity, state = UUID(int=chance.getrandbits(128)), [chance.random(), chance.uniform(-1, 1)]
        goal, cost = [chance.uniform(-1, 1) for _ in range(3)], chance.choice([0.0, -0.0, 1.0, chance.random()])
        trial = {"state": state, "goal": goal, "cost": cost, "success": chance.random() < 0.8, "id": identity}
        task.report(**trial, wait=chance.random() < 0.2)
        self.acknowledged.append(identity)

    def administer(self, task: Any, chance: random.Random) -> None:
        ids = self.acknowledged[-3:]
        if not ids:
            return
        act = chance.choice(["recost", "remove", "refit", "configure", "explain"])
        try:
            if act == "recost":
                task.recost(ids, [chance.choice([0.0, -0.0, 1.0, chance.random()]) for _ in ids])
            elif act == "remove":
                task.remove(ids[:1])
            elif act == "configure":
                task.configure(chance.choice(CHANGES))
            elif act == "explain":
                task.explain([chance.random(), 0.0], ids[0])
            else:
                task.refit()
        except Conflict as error:  # a fit of settings that were changed meanwhile
            if "configured again" not in error.message:
                raise
        self.administered += 1

    def stop(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(60)


def crkr(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "crkr.client", *words], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    "rounds", [1, pytest.param(8, marks=[pytest.mark.campaign, pytest.mark.timeout(300)])], ids=["short", "long"]
)
def test_whatever_happens_at_once_log_model_and_copies_agree(
    rounds: int,
    place: Path | str,
    start_server: Start,
    free_port: int,
    reach: dict[str, Any],
    processes: Processes,
    tmp_path: Path,
) -> None:
    server = start_server(data=place, port=free_port)
    with ExitStack() as stack, Client(server.endpoint, timeout_s=20) as client:
        task, crowd = client.create_task(reach), Crowd(server.endpoint)
        stack.callback(crowd.stop)
        for act in (crowd.report, crowd.report, crowd.administer, crowd.administer):
            crowd.add(act)
        for turn in range(rounds):
            goals = len(crowd.acknowledged) + 60, crowd.administered + 20
            processes.wait_until(
                lambda goals=goals: (
                    crowd.failed or (len(crowd.acknowledged) >= goals[0] and crowd.administered >= goals[1])
                )
            )
            server.process.send_signal(signal.SIGINT if turn % 3 == 2 else signal.SIGKILL)
            copy = tmp_path / f"copy {turn}"
            copy.mkdir()
            crkr("backup", str(place), str(copy / "crkr.sqlite3"))  # beside a server that dies or starts
            server.process.wait(timeout=60)
            server = start_server(data=place, port=free_port)
            assert "agree" in crkr("replay", str(copy))
        processes.wait_until(lambda: crowd.failed or len(crowd.acknowledged) >= goals[0] + 30)
        assert crowd.failed == []
        end = task.archive()["seq"]
        crowd.stop()
        assert {type(error) for error in crowd.failed} == {Invalid}
        assert all("archived" in str(error) for error in crowd.failed)
        stored = list(task.iter_samples())
        assert task.status()["seq"] == end
    assert len({sample.trial.id for sample in stored}) == len(stored)
    assert set(crowd.acknowledged) <= {sample.trial.id for sample in stored}
    server.process.terminate()
    assert server.process.wait(timeout=60) == 0
    assert "agree" in crkr("replay", str(place))
