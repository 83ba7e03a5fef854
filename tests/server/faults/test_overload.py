"""One client that asks too much is told so at once, and the others do not notice."""

import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from processes import RunningServer

from crkr.client import Client

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
OUTSTANDING = 700
# Asks and asks, for what there is or for what there is not, and reads little of what it is told.
GREEDY = """
import sys
import msgpack, zenoh
config = zenoh.Config()
for name, value in {"mode": '"client"', "connect/endpoints": f'["{sys.argv[1]}"]',
                    "scouting/multicast/enabled": "false", "scouting/gossip/enabled": "false"}.items():
    config.insert_json5(name, value)
session, waiting, count = zenoh.open(config), [], 0
key = "crkr/@v1/task/reach/rpc/" + sys.argv[2]
question = msgpack.packb({"states": [[0.5, 0.5]] * 40, "explore": True})
while True:
    waiting.append(session.get(key, zenoh.handlers.FifoChannel(1), payload=question,
                               timeout=60.0, consolidation=zenoh.ConsolidationMode.NONE))
    count += 1
    if count == 500:
        print("asking", flush=True)
    if len(waiting) == 200:
        waiting.pop(0).try_recv()
"""


def test_beyond_a_full_queue_requests_are_refused_as_busy_while_another_client_is_answered(
    ask: Ask, make_trial: MakeTrial, plain: Callable[[str], zenoh.Session], shared_endpoint: str
) -> None:
    trials = [make_trial(number) for number in range(1000)]
    for first in range(0, 1000, 250):
        ask("task/reach/rpc/report", {"trials": trials[first : first + 250], "wait": True})
    task = ask("task/reach/rpc/status")["task"]
    greedy = plain(shared_endpoint)
    page = msgpack.packb({"limit": 300})
    replies = [
        greedy.get(
            f"crkr/@v1/task/{task}/rpc/samples",
            zenoh.handlers.FifoChannel(1),
            payload=page,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=60.0,
        )
        for _ in range(OUTSTANDING)
    ]
    for _ in range(20):
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 20
    assert ask("task/reach/rpc/status")["queues"]["samples"]["waiting"] > 0  # so they overtook the pages
    found: Counter[str] = Counter()
    for reply in replies:
        answer = reply.recv()
        if answer.ok is not None:
            found["page"] += 1
        else:
            assert answer.err is not None
            error = msgpack.unpackb(answer.err.payload.to_bytes())
            assert error["retry_ms"] > 0
            found[error["code"]] += 1
    assert set(found) == {"page", "BUSY"}
    assert found["page"] >= 256


def test_a_tasks_changes_hold_up_no_other_tasks_reports(
    start_server: Callable[..., Any],
    connect: Callable[[str], Ask],
    plain: Callable[[str], zenoh.Session],
    reach: dict[str, Any],
    make_trial: MakeTrial,
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    outcomes = [{"name": f"miss {number}", "tolerance": 0.1, "group": "all"} for number in range(32)]
    trials = [make_trial(number, outcome=[0.0] * 32, success=False) for number in range(256)]
    ask("rpc/create_task", reach)
    ask("rpc/create_task", {**reach, "name": "corrected", "outcome": outcomes})
    ask("task/corrected/rpc/report", {"trials": trials})
    message = {"ids": [each["id"] for each in trials]}
    greedy = plain(server.endpoint)
    replies = [
        greedy.get(
            "crkr/@v1/task/corrected/admin/amend",
            zenoh.handlers.FifoChannel(1),
            payload=msgpack.packb({**message, "outcome": [float(number)] * 32}),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=60.0,
        )
        for number in range(1, 26)
    ]
    assert replies[0].recv().ok is not None
    assert ask("task/reach/rpc/report", {"trials": [make_trial(600)], "wait": True})["accepted"] == 1
    assert ask("rpc/create_task", {**reach, "name": "third"})["created"] is True
    assert ask("task/corrected/rpc/status")["queues"]["amend"]["waiting"] > 0  # so both overtook the corrections
    found = Counter("amended" if each.recv().ok is not None else "refused" for each in replies[1:])
    version = ask("task/corrected/rpc/status")["seq"]
    assert version == 1 + 256 + 1 + found["amended"]
    ask("task/corrected/admin/rollback", {"to": version - 1})
    last = ask("task/corrected/rpc/samples", {"last": 1})["samples"][0]
    assert np.unique(np.frombuffer(last["outcome"]["data"])).tolist() == [float(found["amended"])]


def test_a_client_that_asks_more_than_can_be_refused_does_not_make_another_task_wait_for_all_of_it(
    server: RunningServer, reach: dict[str, Any]
) -> None:
    with Client(server.endpoint) as client:
        client.create_task(reach)
        task = client.create_task({**reach, "name": "other"})
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
        command = [sys.executable, "-c", GREEDY, server.endpoint, "predict"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as greedy:
            try:
                assert greedy.stdout is not None
                assert greedy.stdout.readline() == "asking\n"
                for _ in range(20):
                    assert task.predict([0.5, 0.5], timeout_s=10.0).active == 1
            finally:
                greedy.kill()


@pytest.mark.parametrize("rounds", [1, pytest.param(5, marks=pytest.mark.campaign)], ids=["short", "long"])
def test_clients_that_ask_and_stop_reading_do_not_hold_up_the_others(
    rounds: int, server: RunningServer, reach: dict[str, Any]
) -> None:
    with Client(server.endpoint) as client:
        task = client.create_task(reach)
        task.report(state=[0.5, 0.5], goal=[0.0] * 3, cost=0.5, success=True, wait=True)
        for _ in range(rounds):
            with ExitStack() as stack:
                greedy = []
                for verb in ("predict", "dance", "report"):
                    command = [sys.executable, "-c", GREEDY, server.endpoint, verb]
                    greedy.append(stack.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True)))
                    stack.callback(greedy[-1].kill)
                for process in greedy:
                    assert process.stdout is not None
                    assert process.stdout.readline() == "asking\n"
                for process in greedy:
                    os.kill(process.pid, signal.SIGSTOP)
                until = time.monotonic() + 3.0  # longer than a lease
                while time.monotonic() < until:
                    assert task.predict([0.5, 0.5], timeout_s=4.0).active == 1
