"""Workers that hang: a process that is stopped, a simulation that never returns."""

import os
import re
import signal
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from processes import Processes

from crkr.client import Client, Task
from crkr.protocol import Unavailable, UnknownTask

Start = Callable[..., Any]
IMPATIENT = ("--stall", "1", "--timeout", "1", "--seed", "1")


@pytest.fixture
def train(start_command: Start, task: Task, shared_endpoint: str) -> Start:
    """Starts workers of a skill of this folder on the test's task."""

    def start(skill: str, *words: str) -> Any:
        options = ["--task", task.name, "--connect", shared_endpoint, "--json"]
        return start_command("workers", f"reaching:{skill}", *options, *IMPATIENT, *words)

    return start


def wait_for_trials(task: Task, processes: Processes, command: Any, least: int) -> None:
    def stored() -> bool:
        try:
            return int(sum(task.status()["samples"].values())) > least
        except UnknownTask:
            return False

    processes.wait_until(stored, command.log)


def warnings(log: str) -> list[str]:
    return [line for line in log.splitlines() if line.startswith("warning: worker")]


def states(task: Task) -> list[str]:
    """How the server sees both workers."""
    workers = {worker["id"].rsplit("-", 1)[1]: str(worker["state"]) for worker in task.status()["workers"]}
    return [workers["0"], workers["1"]]


def test_a_stopped_worker_is_given_up_in_one_line_and_the_other_meets_the_total(
    train: Start, task: Task, processes: Processes
) -> None:
    command = train("make", "-n", "2", "--trials", "400", "--evaluations", "10")
    wait_for_trials(task, processes, command, 30)
    stopped = command.members()[0]
    os.kill(stopped, signal.SIGSTOP)
    result = command.result()
    [line] = warnings(command.log.read_text())
    assert re.search(rf"\(process {stopped}\) made no progress for \d+ s and was killed; 1 of 2 go on$", line), line
    assert (result["workers_lost"], result["trained"]) == (1, 400)
    assert processes.running([stopped]) == []
    kinds = [stored.trial for stored in task.iter_samples()]
    assert sum(trial.kind in ("trial", "failed") for trial in kinds) == 400
    balls = Counter(trial.info["epoch"] for trial in kinds if trial.kind == "evaluation")
    assert set(balls.values()) == {10}
    processes.wait_until(lambda: states(task) == ["lost", "left"], command.log)


def test_simulations_that_never_return_are_given_up(train: Start, task: Task) -> None:
    command = train("make_stuck", "-n", "2", "--evaluations", "0")
    status, _, log = command.finish()
    assert status == 1
    lines = warnings(log)
    assert ["made no progress for" in line for line in lines] == [True, True]
    assert log.splitlines()[-1] == "error: all workers are lost"
    assert sum(task.status()["samples"].values()) == 5 + 2 * 40


def test_workers_that_wait_for_the_server_do_not_hang(
    start_server: Start, start_command: Start, task: Task, processes: Processes
) -> None:
    server = start_server()
    words = ("--task", task.name, "--connect", server.endpoint, "--trials", "1000", "--evaluations", "0", "--json")
    command = start_command("workers", "reaching:make", *words, *IMPATIENT)
    with Client(server.endpoint) as client:
        wait_for_trials(client.task(task.name), processes, command, 30)
        server.process.send_signal(signal.SIGSTOP)
        try:
            command.wait_for_line("trying again for 60 s")
            with pytest.raises(Unavailable):
                client.info(timeout_s=4.0)  # longer than a worker may make no progress otherwise
        finally:
            server.process.send_signal(signal.SIGCONT)
    assert command.result()["workers_lost"] == 0
