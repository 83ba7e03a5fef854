"""Two servers on one database, and clients that know both."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.client import Client, Task
from crkr.protocol import TaskSpec

AXES = [{"name": name, "low": -1.0, "high": 1.0} for name in "xy"]
SPEC = TaskSpec.from_dict({"name": "reach", "state": AXES, "goal": AXES, "budget": 30})


@dataclass
class Member:
    """One server process of a pair; it may be ended and started again under the same endpoint."""

    endpoint: str
    data: str
    log: Path
    process: subprocess.Popen[bytes] | None = None

    def start(self, *options: str) -> None:
        command = [sys.executable, "-m", "crkr.client", "server", "--listen", self.endpoint, "--data", self.data]
        with self.log.open("ab") as sink:
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            self.process = subprocess.Popen([*command, *options], stdout=sink, stderr=sink, env=environment)

    def says(self, what: str, times: int = 1) -> bool:
        """Whether it has said something so many times; fails once it has ended."""
        assert self.process is not None
        text = self.log.read_text()
        if text.count(what) >= times:
            return True
        assert self.process.poll() is None, text
        return False

    def send(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)
        if number in (signal.SIGKILL, signal.SIGTERM):
            self.process.wait(60)

    def end(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait(60)


@dataclass
class Pair:
    """An owner, and a server that stands by."""

    url: str
    members: list[Member]
    wait_until: Callable[..., Any]

    @property
    def endpoints(self) -> str:
        return ",".join(member.endpoint for member in self.members)

    def start(self) -> None:
        """Start both at once; the one that gets the log is the first from then on."""
        for member in self.members:
            member.start()
        for member in self.members:
            self.wait_until(lambda member=member: member.says("listening on") or member.says("standing by"), member.log)
        self.members.sort(key=lambda member: not member.says("listening on"))


@pytest.fixture
def pair(make_database: Callable[[], str], tmp_path: Path, processes: Any, unused_ports: list[int]) -> Iterator[Pair]:
    """Two servers that run."""
    url = make_database()
    members = [
        Member(f"tcp/127.0.0.1:{port}", url, tmp_path / f"{name}.log")
        for name, port in zip(("first", "second"), unused_ports, strict=True)
    ]
    made = Pair(url, members, processes.wait_until)
    try:
        made.start()
        yield made
    finally:
        for member in members:
            member.end()
            sys.stdout.write(member.log.read_text() if member.log.exists() else "")


@dataclass
class Reporters:
    """Clients that report without pause, each under ids of its own."""

    endpoints: str
    acknowledged: list[UUID] = field(default_factory=list)
    failed: list[BaseException] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)
    threads: list[threading.Thread] = field(default_factory=list)

    def start(self, count: int) -> None:
        for seed in range(count):
            self.threads.append(threading.Thread(target=self._go_on, args=(seed,)))
            self.threads[-1].start()

    def _go_on(self, seed: int) -> None:
        chance = np.random.default_rng(seed)
        try:
            with Client(self.endpoints, timeout_s=60) as client:
                task = client.task("reach")
                while not self.stop.is_set():
                    identity = uuid4()
                    state, goal = chance.uniform(-1, 1, 2), chance.uniform(-1, 1, 2)
                    task.report(id=identity, state=state, goal=goal, cost=float(chance.uniform()), success=True)
                    self.acknowledged.append(identity)
        except BaseException as error:  # told by the test's own thread
            self.failed.append(error)

    def end(self) -> None:
        self.stop.set()
        for thread in self.threads:
            thread.join(90)


@pytest.fixture
def reporters(pair: Pair) -> Iterator[Reporters]:
    """Three of them, of the task `reach`, which is made; they know both servers."""
    with Client(pair.endpoints, timeout_s=60) as client:
        client.create_task(SPEC)
    made = Reporters(pair.endpoints)
    made.start(3)
    try:
        yield made
    finally:
        made.end()


@pytest.fixture
def task(pair: Pair) -> Iterator[Task]:
    """The task `reach`, by a client that knows both servers."""
    with ExitStack() as stack:
        client = stack.enter_context(Client(pair.endpoints, timeout_s=60))
        yield client.create_task(SPEC)
