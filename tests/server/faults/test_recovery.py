"""Clients go on by themselves over a server that is killed or held, and each report arrives once."""

import os
import signal
import subprocess
import threading
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any
from uuid import UUID

import pytest
from processes import Processes, RunningServer

from crkr.client import Client
from crkr.protocol import Trial, Unavailable

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Start = Callable[..., Any]
READY_S = 20.0


def report_until(client: Client, stop: threading.Event, first: int, acknowledged: list[UUID]) -> None:
    """Reports without pause; every call has time for the server to come back."""
    task, number = client.task("reach"), first
    while not stop.is_set():
        number += 1
        identity = UUID(int=number)
        receipt = task.report(
            state=[0.5, 0.5], goal=[0.0, 0.0, 0.0], cost=0.5, success=True, id=identity, timeout_s=60.0
        )
        assert len(receipt.seqs) == 1
        acknowledged.append(identity)


def disturbed(
    start_server: Start, port: int, reach: dict[str, Any], disturb: Callable[[Any], Any], times: int, spell: int
) -> None:
    """Three clients report while the server is disturbed again and again, after every `spell` reports of each."""
    server = start_server(port=port)
    stop = threading.Event()
    acknowledged: list[list[UUID]] = [[], [], []]
    with ExitStack() as stack:
        clients = [stack.enter_context(Client(server.endpoint)) for _ in acknowledged]
        clients[0].create_task(reach)
        threads = [
            threading.Thread(target=report_until, args=(client, stop, (part + 1) * 10**9, mine))
            for part, (client, mine) in enumerate(zip(clients, acknowledged, strict=True))
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in range(times):
                goals = [len(mine) + spell for mine in acknowledged]
                while any(len(mine) < goal for mine, goal in zip(acknowledged, goals, strict=True)):
                    threads[0].join(timeout=0.02)
                    assert all(thread.is_alive() for thread in threads)
                server = disturb(server)
        finally:
            stop.set()
            for thread in threads:
                thread.join(timeout=70)
        stored = [sample.trial.id for sample in clients[0].task("reach").iter_samples()]
    assert len(stored) == len(set(stored))
    assert set(stored) == {one for mine in acknowledged for one in mine}


@pytest.fixture
def kill(start_server: Start, free_port: int) -> Callable[[Any], Any]:
    def killed(server: RunningServer) -> Any:
        server.process.kill()
        server.process.wait(timeout=60)
        return start_server(port=free_port)

    return killed


def hold(server: RunningServer) -> Any:
    os.kill(server.process.pid, signal.SIGSTOP)
    with pytest.raises(subprocess.TimeoutExpired):
        server.process.wait(timeout=3.0)  # longer than the lease: clients lose their connection
    os.kill(server.process.pid, signal.SIGCONT)
    return server


def test_clients_go_on_over_a_killed_server(
    start_server: Start, free_port: int, reach: dict[str, Any], kill: Callable[[Any], Any]
) -> None:
    disturbed(start_server, free_port, reach, kill, times=2, spell=30)


def test_over_a_held_server_calls_end_by_their_deadline_and_what_they_sent_arrives_once(
    server: RunningServer, reach: dict[str, Any]
) -> None:
    with Client(server.endpoint) as client:
        task = client.create_task(reach)

        def report(number: int, timeout_s: float) -> tuple[int, ...]:
            given = [
                Trial.create(task.spec, id=UUID(int=number), state=[0.5] * 2, goal=[0] * 3, cost=0.5, success=True)
            ]
            return task.report_trials(given, wait=True, timeout_s=timeout_s).seqs

        assert report(1, 20.0) == (2,)
        os.kill(server.process.pid, signal.SIGSTOP)
        for number in (2, 3):
            with pytest.raises(Unavailable, match="no answer"):
                report(number, 0.7)
        with pytest.raises(Unavailable, match="no answer"):
            task.predict([0.5, 0.5], timeout_s=0.7)
        with pytest.raises(Unavailable, match="no answer"):
            task.status(timeout_s=0.3)
        os.kill(server.process.pid, signal.SIGCONT)
        assert sorted(report(3, 20.0) + report(2, 20.0) + report(1, 20.0)) == [2, 3, 4]
        assert task.predict([0.5, 0.5]).active == 3
        stored = [sample.trial.id.int for sample in task.iter_samples()]
    assert sorted(stored) == [1, 2, 3]


def test_subscriptions_and_tokens_stand_again_after_the_server_came_back(
    start_server: Start, free_port: int, reach: dict[str, Any], kill: Callable[[Any], Any], processes: Processes
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=20) as worker, Client(server.endpoint, timeout_s=20) as watcher:
        task, watching = worker.create_task(reach), watcher.task("reach")
        numbers = iter(range(1, 10**6))

        def heard(subscription: Any) -> bool:
            """Whether another report brings another notice."""
            identity = UUID(int=next(numbers))
            version = task.report(
                state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, id=identity, wait=True
            ).model_version
            found = subscription.receive(0.5)
            while found is not None and found[1]["version"] < version:
                found = subscription.receive(0.5)
            return found is not None

        def alive() -> bool:
            return [(entry["id"], entry["state"]) for entry in watching.status()["workers"]] == [("ada", "alive")]

        with task.announce("ada"), watching.subscribe(["model"]) as subscription:
            processes.wait_until(lambda: heard(subscription))
            processes.wait_until(alive)
            for _ in range(2):
                server = kill(server)
                processes.wait_until(lambda: heard(subscription))
                processes.wait_until(alive)
                assert task.predict([0.5, 0.5]).active > 0
        processes.wait_until(lambda: [entry["state"] for entry in watching.status()["workers"]] == ["left"])


@pytest.mark.campaign
@pytest.mark.timeout(600)
def test_clients_go_on_over_many_killed_servers(
    start_server: Start, free_port: int, reach: dict[str, Any], kill: Callable[[Any], Any]
) -> None:
    disturbed(start_server, free_port, reach, kill, times=25, spell=200)


@pytest.mark.campaign
@pytest.mark.timeout(300)
def test_clients_go_on_over_a_server_that_is_held_again_and_again(
    start_server: Start, free_port: int, reach: dict[str, Any]
) -> None:
    disturbed(start_server, free_port, reach, hold, times=6, spell=100)
