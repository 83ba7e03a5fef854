"""Clients go on by themselves: over a server that is killed, stopped or cut off, each report arrives once."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Start = Callable[..., Any]
READY_S = 20.0
OUTAGE_S = 4.0  # longer than a lease, so that the partition is noticed


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
    """Two clients report while the server is disturbed again and again, after every `spell` reports of each."""
    server = start_server(port=port)
    stop = threading.Event()
    acknowledged: list[list[UUID]] = [[], []]
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
    def killed(server: Any) -> Any:
        server.process.kill()
        server.process.wait(timeout=5)
        return start_server(port=free_port)

    return killed


def hold(server: Any) -> Any:
    os.kill(server.process.pid, signal.SIGSTOP)
    threading.Event().wait(3.0)  # longer than the lease: clients lose their connection
    os.kill(server.process.pid, signal.SIGCONT)
    return server


def test_clients_go_on_over_a_killed_server(
    start_server: Start, free_port: int, reach: dict[str, Any], kill: Callable[[Any], Any]
) -> None:
    disturbed(start_server, free_port, reach, kill, times=2, spell=30)


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


REPORTER = """
import json, sys
from uuid import UUID
from crkr.client import Client
endpoint, spec, count = sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3])
with Client(endpoint, timeout_s=60) as client:
    client.wait_until_ready(20)
    task = client.create_task(spec)
    for number in range(1, count + 1):
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, id=UUID(int=number))
        print(number, flush=True)
    print(json.dumps([sample.trial.id.int for sample in task.iter_samples()]), flush=True)
"""


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@contextmanager
def two_machines() -> Iterator[tuple[str, str]]:
    """Two network namespaces with a cable between them: 10.77.0.1 in the first, 10.77.0.2 in the second."""
    one, two = f"crkr-{os.getpid()}-a", f"crkr-{os.getpid()}-b"
    with ExitStack() as stack:
        for name in (one, two):
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name)
        ip("-n", one, "link", "add", "cable", "type", "veth", "peer", "name", "cable", "netns", two)
        for name, address in ((one, "10.77.0.1/24"), (two, "10.77.0.2/24")):
            ip("-n", name, "address", "add", address, "dev", "cable")
            ip("-n", name, "link", "set", "cable", "up")
            ip("-n", name, "link", "set", "lo", "up")
        yield one, two


@pytest.mark.campaign
@pytest.mark.timeout(120)
def test_over_a_cut_cable_everything_arrives_once(tmp_path: Path, reach: dict[str, Any]) -> None:
    """Needs the right to make network namespaces."""
    count = 400
    with two_machines() as (one, two), ExitStack() as stack:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            endpoint = f"tcp/10.77.0.1:{probe.getsockname()[1]}"
        python = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(tmp_path / "data")]
        server = stack.enter_context(
            subprocess.Popen(["ip", "netns", "exec", one, *python], stderr=subprocess.PIPE, text=True)
        )
        stack.callback(server.kill)
        assert server.stderr is not None
        assert "listening on" in server.stderr.readline()
        script = [sys.executable, "-c", REPORTER, endpoint, json.dumps(reach), str(count)]
        client = stack.enter_context(
            subprocess.Popen(["ip", "netns", "exec", two, *script], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(client.kill)
        assert client.stdout is not None
        lines = []
        for end in (one, two):
            lines += [client.stdout.readline() for _ in range(50)]
            ip("-n", end, "link", "set", "cable", "down")
            with pytest.raises(subprocess.TimeoutExpired):
                client.wait(timeout=OUTAGE_S)
            ip("-n", end, "link", "set", "cable", "up")
        lines += client.stdout.readlines()
        assert client.wait(timeout=10) == 0
        server.terminate()
        assert server.wait(timeout=10) == 0
    assert [int(line) for line in lines[:-1]] == list(range(1, count + 1))
    assert json.loads(lines[-1]) == list(range(1, count + 1))
