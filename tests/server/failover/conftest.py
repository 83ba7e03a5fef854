"""Two servers on one database, one that stands by or both with a share of the tasks, and clients that know both."""

import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from postgres import Postgres
from processes import Processes

from crkr.client import Client, Task
from crkr.protocol import TaskSpec, Trial

AXES = [{"name": name, "low": -1.0, "high": 1.0} for name in "xy"]
SPEC = TaskSpec.from_dict({"name": "reach", "state": AXES, "goal": AXES, "budget": 30})


@dataclass
class Member:
    """One server process of a pair; it may be ended and started again under the same endpoint."""

    endpoint: str
    data: str
    log: Path
    options: tuple[str, ...] = ()
    process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [sys.executable, "-m", "crkr.client", "server", "--listen", self.endpoint, "--data", self.data]
        with self.log.open("ab") as sink:
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            self.process = subprocess.Popen([*command, *self.options], stdout=sink, stderr=sink, env=environment)

    def says(self, what: str, times: int = 1) -> bool:
        """Whether it has said something that often; fails once it has ended."""
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
    """An owner, and a server that stands by, or that shares the tasks as its peer."""

    url: str
    members: list[Member]
    wait_until: Callable[..., Any]

    @property
    def endpoints(self) -> str:
        return ",".join(member.endpoint for member in self.members)

    def start(self, *, in_turn: bool = False) -> None:
        """Start both; the one that gets the log is the first from then on."""
        for number, member in enumerate(self.members):
            member.start()
            if in_turn or number:
                self._wait(member)
        self._wait(self.members[0])
        self.members.sort(key=lambda member: not member.says("listening on"))

    def _wait(self, member: Member) -> None:
        self.wait_until(lambda: member.says("listening on") or member.says("standing by"), member.log)


@pytest.fixture
def make_pair(
    make_database: Callable[[], str], postgres: Postgres, tmp_path: Path, processes: Processes, unused_ports: list[int]
) -> Iterator[Callable[..., Pair]]:
    """Starts two servers; the first, which gets the log, may reach the database by another port than the second.

    The second shares the tasks if it is given an endpoint of the first, "" for the one where it listens.
    """
    made: list[Pair] = []

    def make(port: int | None = None, peer: str | None = None) -> Pair:
        url = make_database()
        first = url if port is None else url.replace(f":{postgres.port}/", f":{port}/")
        members = [
            Member(f"tcp/127.0.0.1:{listen}", data, tmp_path / f"{name}.log")
            for name, listen, data in zip(("first", "second"), unused_ports, (first, url), strict=True)
        ]
        if peer is not None:
            members[1].options = ("--peer", peer or members[0].endpoint)
        made.append(Pair(url, members, processes.wait_until))
        made[0].start(in_turn=port is not None or peer is not None)
        return made[0]

    try:
        yield make
    finally:
        for member in made[0].members if made else ():
            member.end()
            sys.stdout.write(member.log.read_text() if member.log.exists() else "")


@pytest.fixture
def pair(make_pair: Callable[..., Pair]) -> Pair:
    """Two servers that run."""
    return make_pair()


@dataclass
class Reporters:
    """Clients that report without pause, each under ids of its own, and ask for goals in between.

    No model that answers them is older than one before.
    """

    endpoints: str
    tasks: tuple[str, ...] = ("reach",)
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
        versions = dict.fromkeys(self.tasks, 0)
        endpoints = self.endpoints.split(",")
        endpoints = endpoints[seed % 2 :] + endpoints[: seed % 2]
        try:
            with Client(",".join(endpoints), timeout_s=60) as client:
                tasks = [client.task(name) for name in self.tasks]
                for number in itertools.count():
                    if self.stop.is_set():
                        return
                    task, identity = tasks[number % len(tasks)], uuid4()
                    state, goal = chance.uniform(-1, 1, 2), chance.uniform(-1, 1, 2)
                    trial = Trial.create(
                        SPEC, id=identity, state=state, goal=goal, cost=chance.uniform(), success=True, kind="trial"
                    )
                    task.report_trials([trial], wait=number < len(tasks))
                    self.acknowledged.append(identity)
                    if number % 8 < len(tasks):
                        version = task.predict(state).model_version
                        assert version >= versions[task.name]
                        versions[task.name] = version
        except BaseException as error:  # told by the test's own thread
            self.failed.append(error)

    def end(self) -> None:
        self.stop.set()
        for thread in self.threads:
            thread.join(90)


@pytest.fixture
def start_reporters() -> Iterator[Callable[[Pair], Reporters]]:
    """Starts three of them, of tasks that are made, usually `reach`; they know both servers."""
    made: list[Reporters] = []

    def start(pair: Pair, tasks: tuple[str, ...] = ("reach",)) -> Reporters:
        with Client(pair.endpoints, timeout_s=60) as client:
            for name in tasks:
                client.create_task(replace(SPEC, name=name))
        made.append(Reporters(pair.endpoints, tasks))
        made[0].start(3)
        return made[0]

    try:
        yield start
    finally:
        for one in made:
            one.end()


@pytest.fixture
def reporters(pair: Pair, start_reporters: Callable[[Pair], Reporters]) -> Reporters:
    """Three of them that report."""
    return start_reporters(pair)


@pytest.fixture
def task(pair: Pair) -> Iterator[Task]:
    """The task `reach`, by a client that knows both servers."""
    with ExitStack() as stack:
        client = stack.enter_context(Client(pair.endpoints, timeout_s=60))
        yield client.create_task(SPEC)
