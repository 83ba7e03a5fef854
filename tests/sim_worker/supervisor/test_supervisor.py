"""`crkr workers` on bad days: lost processes, lost servers, second supervisors, signals."""

import json
import os
import re
import signal
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import Processes

from crkr.client import Client, Task
from crkr.protocol import UnknownTask

Start = Callable[..., Any]


@pytest.fixture
def train(start_command: Start, task: Task, shared_endpoint: str) -> Start:
    """Starts workers of the test's skill on the test's task."""

    def start(*words: str, skill: str = "reaching:make", evaluations: int = 0, endpoint: str = "") -> Any:
        options = ["--connect", endpoint or shared_endpoint, "--evaluations", str(evaluations), "--json"]
        return start_command("workers", skill, "--task", task.name, *options, *words)

    return start


def trials(task: Task, *kinds: str) -> list[Any]:
    return [stored.trial for stored in task.iter_samples() if stored.trial.kind in kinds]


def trained(task: Task) -> int:
    return len(trials(task, "trial", "failed"))


def under_way(task: Task, processes: Processes, command: Any, least: int = 20) -> None:
    """Returns once workers have stored some trials."""

    def stored() -> bool:
        try:
            return int(sum(task.status()["samples"].values())) > least
        except UnknownTask:
            return False

    processes.wait_until(stored, command.log)


def test_a_killed_worker_is_named_and_the_rest_meet_the_total(train: Start, task: Task, processes: Processes) -> None:
    command = train("-n", "3", "--trials", "400", "--seed", "1")
    under_way(task, processes, command)
    os.kill(command.members()[-1], signal.SIGKILL)
    result = command.result()
    assert "was killed by SIGKILL; 2 of 3 go on" in command.log.read_text()
    assert result["workers_lost"] == 1
    assert trained(task) == 400


def test_a_total_counts_the_trials_that_others_report_meanwhile(train: Start, task: Task, processes: Processes) -> None:
    command = train("-n", "2", "--trials", "600", "--seed", "1")
    for count in (50, 200, 500):
        under_way(task, processes, command, least=count)
        task.report(state=[0.1, 0.2], goal=[0.1, 0.2], cost=0.5, success=False)
    result = command.result()
    assert result["trials"] == 597
    assert result["trained"] == trained(task) == 600


def test_when_the_last_worker_is_lost_the_supervisor_fails_with_one_line(
    train: Start, task: Task, processes: Processes
) -> None:
    command = train("-n", "2", "--seed", "1")
    under_way(task, processes, command)
    for member in command.members():
        os.kill(member, signal.SIGKILL)
    status, _, log = command.finish()
    assert status == 1
    assert [line for line in log.splitlines() if line.startswith("error: ")] == ["error: all workers are lost"]


def test_what_a_lost_worker_had_to_judge_is_judged_by_another(train: Start, task: Task, processes: Processes) -> None:
    command = train("-n", "2", "--trials", "150", "--seed", "1", evaluations=40)
    under_way(task, processes, command, least=6)
    os.kill(command.members()[0], signal.SIGKILL)
    command.result()
    balls = Counter(trial.info["epoch"] for trial in trials(task, "evaluation"))
    assert balls == {0: 40, 1: 40, 2: 40, 3: 40}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_every_process_within_five_seconds_with_a_summary(
    number: signal.Signals, train: Start, task: Task, processes: Processes
) -> None:
    command = train("-n", "2", "--seed", "1", evaluations=10)
    under_way(task, processes, command)
    processes.wait_until(lambda: trials(task, "evaluation"), command.log)
    members = command.members()
    sent = time.monotonic()
    command.process.send_signal(number)
    status, output, log = command.finish()
    assert time.monotonic() - sent < 5.0  # that is the promise
    assert status == 128 + number
    assert processes.running(members) == []
    assert "training trials" in log.splitlines()[-1]
    assert "Traceback" not in log
    report = json.loads(output)
    assert report["trials"] == report["trained"] == trained(task)
    balls = Counter(trial.info["epoch"] for trial in trials(task, "evaluation"))
    # Each epoch whole or not at all: the last one may end with a trial that was under way when the signal came.
    assert balls == {epoch["epoch"]: 10 for epoch in report["epochs"]}
    assert balls.keys() <= set(range(trained(task) // 50 + 1))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_a_terminal_sends_to_the_whole_group_ends_it_quietly(
    number: signal.Signals, train: Start, task: Task, processes: Processes
) -> None:
    command = train("-n", "2", "--seed", "1")
    under_way(task, processes, command)
    for pid in [*processes.descendants(command.process.pid), command.process.pid]:
        os.kill(pid, number)
    status, _, log = command.finish()
    assert status == 128 + number, log
    assert "warning" not in log
    assert "Traceback" not in log


def test_nothing_outlives_a_killed_supervisor(train: Start, task: Task, processes: Processes) -> None:
    command = train("-n", "2", "--seed", "1", evaluations=10)
    under_way(task, processes, command)
    everyone = processes.descendants(command.process.pid)
    command.process.kill()
    processes.wait_until(lambda: not processes.running(everyone))


def test_a_run_is_taken_up_where_it_was_left(train: Start, task: Task) -> None:
    train("--trials", "60", "--seed", "1", evaluations=5).result()
    second = train("--trials", "130", "--seed", "1", evaluations=5).result()
    assert trained(task) == 130
    assert second["trials"] == 70
    assert second["demonstrations"] == 0
    assert [epoch["epoch"] for epoch in second["epochs"]] == [2]
    assert Counter(trial.info["epoch"] for trial in trials(task, "evaluation")) == {0: 5, 1: 5, 2: 5}
    assert len(trials(task, "demonstration")) == 5


def test_two_supervisors_that_start_together_share_five_demonstrations(train: Start, task: Task) -> None:
    both = [train("-n", "1", "--trials", "600") for _ in range(2)]
    results = [command.result() for command in both]
    assert len(trials(task, "demonstration")) == 5 == sum(result["demonstrations"] for result in results)
    assert 600 <= trained(task) <= 604  # what both had under way at the end


def test_two_supervisors_with_one_seed_both_complete(train: Start, task: Task) -> None:
    both = [train("-n", "1", "--trials", "100", "--seed", "3") for _ in range(2)]
    results = [command.result() for command in both]
    assert all(result["workers_lost"] == 0 for result in results)
    assert sum(result["trials"] for result in results) == trained(task) >= 100


def test_a_supervisor_with_another_seed_joins_the_task_and_says_whose_seed_counts(train: Start, task: Task) -> None:
    train("--trials", "10", "--seed", "1").result()
    second = train("--trials", "20", "--seed", "2")
    assert second.result()["trained"] == 20
    assert f"task {task.name} exists and keeps its seed 1" in second.log.read_text()
    assert task.spec.seed == 1


def test_a_task_of_another_kind_is_refused_by_the_fields_that_differ(train: Start) -> None:
    train("--trials", "1").result()
    status, _, log = train("--trials", "2", "--preset", "small").finish()
    assert status == 1
    assert "these fields differ: budget" in log.splitlines()[-1]


def test_without_demonstrations_training_starts_from_nothing(train: Start, task: Task) -> None:
    assert train("--demonstrations", "0", "--trials", "5").result()["demonstrations"] == 0
    assert trained(task) == 5
    assert trials(task, "demonstration") == []


def test_a_skill_of_three_methods_trains_and_says_in_a_line_each_what_it_lacks(train: Start, task: Task) -> None:
    train("--trials", "1", "--seed", "1").result()
    command = train("--trials", "20", "--seed", "2", skill="reaching:make_bare", evaluations=5)
    assert command.result()["trained"] == trained(task) == 20
    log = command.log.read_text()
    assert "skill reaching:make_bare has no demonstrations: training starts from what the server proposes\n" in log
    assert "skill reaching:make_bare has no scene: displays show no shapes\n" in log
    assert "warning" not in log


@pytest.mark.parametrize(
    ("skill", "complaint"),
    [("tabel-tennis", "error: no skill 'tabel-tennis'; installed: "), ("skill_without_library:make", "")],
)
def test_an_unknown_skill_fails_before_anything_is_made(train: Start, task: Task, skill: str, complaint: str) -> None:
    status, _, log = train(skill=skill).finish()
    assert status == 1
    assert complaint in log.splitlines()[-1]
    with pytest.raises(UnknownTask):
        task.status()


def test_workers_that_come_before_the_server_wait_for_it(
    train: Start, start_server: Start, free_port: int, tmp_path: Path
) -> None:
    command = train("--trials", "10", endpoint=f"tcp/127.0.0.1:{free_port}")
    command.wait_for_line("waiting up to 60 s for a server")
    start_server(data=tmp_path / "late", port=free_port)
    assert command.result()["trained"] == 10


def test_workers_give_up_on_a_server_that_never_comes(start_command: Start, free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    status, _, log = start_command("workers", "reaching:make", "--connect", endpoint, "--patience", "1.5").finish()
    assert status == 1
    assert log.splitlines()[-1].startswith(f"error: no server at {endpoint}")


def test_a_call_to_a_server_that_is_held_has_the_deadline_that_was_asked_for(
    train: Start, task: Task, start_server: Start, processes: Processes, tmp_path: Path
) -> None:
    server = start_server(data=tmp_path / "held")
    command = train("--trials", "1200", "--seed", "1", "--timeout", "1.5", endpoint=server.endpoint)
    with Client(server.endpoint) as client:
        under_way(client.task(task.name), processes, command)
    server.process.send_signal(signal.SIGSTOP)
    try:
        warning = command.wait_for_line("trying again for 60 s")
    finally:
        server.process.send_signal(signal.SIGCONT)
    tried = re.search(r" in ([0-9.]+) s and", warning)
    assert tried is not None, warning
    assert 1.5 <= float(tried[1]) < 5.0
    assert command.result()["trained"] == 1200


def test_a_server_that_was_killed_and_comes_back_finds_its_workers_at_work(
    train: Start, task: Task, start_server: Start, processes: Processes, tmp_path: Path, free_port: int
) -> None:
    data = tmp_path / "restarted"
    first = start_server(data=data, port=free_port)
    with Client(first.endpoint) as client:
        command = train("-n", "2", "--trials", "800", "--seed", "1", evaluations=5, endpoint=first.endpoint)
        task = client.task(task.name)
        under_way(task, processes, command)
        first.process.kill()
        command.wait_for_line("trying again for 60 s")
        start_server(data=data, port=free_port)
        result = command.result()
        assert "the server answers again" in command.log.read_text()
        assert result["workers_lost"] == 0
        assert trained(task) == 800


def test_one_worker_that_waits_repeats_a_whole_run(
    train: Start, task: Task, start_server: Start, tmp_path: Path
) -> None:
    runs = []
    for name in ("first", "second"):
        server = start_server(data=tmp_path / name)
        train("--trials", "40", "--seed", "5", "--wait", endpoint=server.endpoint).result()
        with Client(server.endpoint) as client:
            runs.append(trials(client.task(task.name), "trial", "failed", "demonstration"))
    assert [trial.id for trial in runs[0]] == [trial.id for trial in runs[1]]
    np.testing.assert_array_equal([trial.goal for trial in runs[0]], [trial.goal for trial in runs[1]])
