"""Clients and workers are killed in the middle of what they do: the server goes on, and keeps nothing of them."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from processes import Processes, RunningServer

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Start = Callable[..., Any]
StartWorker = Callable[..., "subprocess.Popen[str]"]

# Predicts and reports without pause on several threads; says which reports were acknowledged.
BUSY = """
import sys, threading
from crkr.client import Client
endpoint, name = sys.argv[1:3]
with Client(endpoint, timeout_s=30) as client:
    task = client.task("reach")
    def ask():
        while True:
            task.predict([[0.5, 0.5]] * 300, explore=True)
            task.samples(limit=500)
    with task.announce(name):
        for _ in range(2):
            threading.Thread(target=ask, daemon=True).start()
        while True:
            answer = task.predict([0.5, 0.5], explore=True, worker=name)
            task.report(answer, cost=0.5, success=True, worker=name)
            print(answer.trial_id, flush=True)
"""
# Asks for a goal to try, and then waits to be told what next.
TRYING = """
import sys
from crkr.client import Client
endpoint, name = sys.argv[1:3]
with Client(endpoint, timeout_s=30) as client:
    task = client.task("reach")
    with task.announce(name):
        print(task.predict([0.5, 0.5], explore=True, worker=name).trial_id, flush=True)
        sys.stdin.readline()
"""


@pytest.fixture
def start_worker() -> Iterator[StartWorker]:
    with ExitStack() as stack:

        def start(script: str, endpoint: str, name: str) -> "subprocess.Popen[str]":
            command = [sys.executable, "-c", script, endpoint, name]
            pipe = subprocess.PIPE
            process = stack.enter_context(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
            stack.callback(process.kill)
            return process

        yield start


@pytest.fixture
def ask(server: RunningServer, connect: Callable[[str], Ask], make_trial: MakeTrial, reach: dict[str, Any]) -> Ask:
    """Questions to a server whose task has one demonstration."""
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    return ask


def line(process: "subprocess.Popen[str]") -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def workers(ask: Ask) -> dict[str, dict[str, Any]]:
    return {worker["id"]: worker for worker in ask("task/reach/rpc/status")["workers"]}


def held(pid: int) -> tuple[int, int, int]:
    """Memory [bytes], open files and threads of a process."""
    memory = int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE")
    return memory, len(os.listdir(f"/proc/{pid}/fd")), len(os.listdir(f"/proc/{pid}/task"))


def waiting(ask: Ask) -> int:
    return sum(queue["waiting"] for queue in ask("task/reach/rpc/status")["queues"].values())


def stored(endpoint: str) -> list[UUID]:
    with Client(endpoint) as client:
        return [sample.trial.id for sample in client.task("reach").iter_samples()]


@pytest.mark.parametrize(
    "rounds",
    [2, pytest.param(10, marks=[pytest.mark.campaign, pytest.mark.timeout(300)])],
    ids=["short", "long"],
)
def test_killed_clients_leave_their_reports_and_nothing_else(
    rounds: int, server: RunningServer, ask: Ask, processes: Processes, start_worker: StartWorker
) -> None:
    acknowledged: set[UUID] = set()
    before = after = (0, 0, 0)
    for turn in range(rounds):
        names = [f"w-{turn}-{number}" for number in range(2)]
        busy = [start_worker(BUSY, server.endpoint, name) for name in names]
        acknowledged |= {UUID(line(process)) for process in busy for _ in range(100)}
        processes.wait_until(lambda names=names: all(workers(ask)[name]["state"] == "alive" for name in names))
        for process in busy:
            process.kill()
        for process in busy:
            assert process.stdout is not None
            whole = [text for text in process.stdout.read().split("\n")[:-1] if text]
            acknowledged |= {UUID(text) for text in whole}
            process.wait(timeout=60)
        processes.wait_until(lambda names=names: all(workers(ask)[name]["state"] == "lost" for name in names))
        assert all(workers(ask)[name]["open_trials"] <= 1 for name in names)
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.5]})["active"] >= 1
        processes.wait_until(lambda: waiting(ask) == 0)
        after = held(server.process.pid)
        before = after if turn == 0 else before
    assert after[0] - before[0] < 30e6  # what was learned from is among it
    assert after[1] <= before[1] + 3  # a reader's files are opened when first needed
    assert after[2] <= before[2] + 3
    found = stored(server.endpoint)
    assert len(found) == len(set(found))
    assert acknowledged <= set(found)


def test_lost_stuck_and_finished_workers_are_told_apart_and_a_late_report_is_data(
    server: RunningServer, ask: Ask, make_trial: MakeTrial, processes: Processes, start_worker: StartWorker
) -> None:
    ends = {name: start_worker(TRYING, server.endpoint, name) for name in ("killed", "finished", "stuck")}
    open_trials = {name: UUID(line(process)) for name, process in ends.items()}
    trying = dict.fromkeys(("finished", "killed", "stuck"), ("alive", 1))  # a token may arrive after the first question
    processes.wait_until(
        lambda: {name: (one["state"], one["open_trials"]) for name, one in workers(ask).items()} == trying
    )
    ends["killed"].kill()
    os.kill(ends["stuck"].pid, signal.SIGSTOP)
    ends["finished"].communicate("\n", timeout=60)
    wanted = {"killed": "lost", "finished": "left", "stuck": "lost"}
    processes.wait_until(lambda: {name: one["state"] for name, one in workers(ask).items()} == wanted)
    first = workers(ask)["stuck"]
    second = workers(ask)["stuck"]
    assert 0 < first["oldest_open_s"] < second["oldest_open_s"]
    assert 0 < first["last_seen_s"] < second["last_seen_s"] < second["oldest_open_s"]
    os.kill(ends["stuck"].pid, signal.SIGCONT)
    processes.wait_until(lambda: workers(ask)["stuck"]["state"] == "alive")
    for name, trial_id in open_trials.items():
        late = make_trial(1, id=trial_id.bytes, worker=name)
        assert ask("task/reach/rpc/report", {"trials": [late], "wait": True})["accepted"] == 1
        assert (workers(ask)[name]["open_trials"], workers(ask)[name]["oldest_open_s"]) == (0, None)
    assert set(open_trials.values()) <= set(stored(server.endpoint))


def test_a_worker_that_takes_the_name_of_a_killed_one_is_alive(
    server: RunningServer, ask: Ask, processes: Processes, start_worker: StartWorker
) -> None:
    first = start_worker(TRYING, server.endpoint, "ada")
    line(first)
    first.kill()
    second = start_worker(TRYING, server.endpoint, "ada")
    assert uuid4().version == UUID(line(second)).version
    processes.wait_until(lambda: workers(ask)["ada"]["state"] == "alive")
    assert workers(ask)["ada"]["open_trials"] == 2
