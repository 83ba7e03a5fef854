"""Several supervisors train one task: its epochs are judged once, whichever of them starts, ends or dies."""

import signal
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from processes import Processes

from crkr.client import Task
from crkr.protocol import StoredTrial, UnknownTask

Start = Callable[..., Any]
BALLS = 20
FOLLOWS = "another supervisor judges the epochs"
TAKES_OVER = "this supervisor judges the epochs"


@pytest.fixture
def train(start_command: Start, task: Task, shared_endpoint: str) -> Start:
    """Starts a supervisor of one worker on the test's task."""

    def start(*words: str) -> Any:
        options = ["--task", task.name, "--connect", shared_endpoint, "--evaluations", str(BALLS), "--json"]
        return start_command("workers", "reaching:make", *options, *words)

    return start


def evaluations(task: Task) -> list[StoredTrial]:
    try:
        return [stored for stored in task.iter_samples() if stored.trial.kind == "evaluation"]
    except UnknownTask:
        return []


def judges(task: Task) -> dict[int, set[str]]:
    """Supervisors whose workers judged each epoch; a worker is named after its supervisor's process."""
    found: dict[int, set[str]] = {}
    for stored in evaluations(task):
        found.setdefault(stored.trial.info["epoch"], set()).add(str(stored.trial.worker).rsplit("-", 1)[0])
    return found


def test_of_two_supervisors_that_start_together_one_has_every_epoch_judged_once(train: Start, task: Task) -> None:
    both = [train("--trials", "1000") for _ in range(2)]
    results = [command.result() for command in both]
    epochs = sorted([epoch["epoch"] for epoch in result["epochs"]] for result in results)
    assert epochs == [[], list(range(results[0]["trained"] // 50 + 1))]
    assert len(set.union(*judges(task).values())) == 1
    assert set(Counter(stored.trial.info["epoch"] for stored in evaluations(task)).values()) == {BALLS}
    assert sorted(FOLLOWS in command.log.read_text() for command in both) == [False, True]
    assert all(result["trials"] > 0 for result in results)


def test_the_first_epochs_model_knows_the_demonstrations_only(train: Start, task: Task) -> None:
    for command in [train("--trials", "60") for _ in range(2)]:
        command.result()
    first = [stored.trial for stored in evaluations(task) if stored.trial.info["epoch"] == 0]
    assert {(trial.model_version, trial.info["trained"]) for trial in first} == {(6, 0)}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_when_the_supervisor_that_judges_ends_another_takes_over(
    number: signal.Signals, train: Start, task: Task, processes: Processes
) -> None:
    first = train("--seed", "1")
    processes.wait_until(lambda: 1 in judges(task), first.log)
    second = train("--seed", "2")
    second.wait_for_line(FOLLOWS)
    first.process.send_signal(number)
    second.wait_for_line(TAKES_OVER)
    processes.wait_until(lambda: len(set.union(*judges(task).values())) == 2, second.log)
    second.process.send_signal(signal.SIGINT)
    assert second.finish()[0] == 130
    assert all(len(names) == 1 for names in judges(task).values())
    assert set(Counter(stored.trial.info["epoch"] for stored in evaluations(task)).values()) == {BALLS}


def test_a_supervisor_that_judges_nothing_leaves_it_to_the_other(train: Start, task: Task) -> None:
    idle = train("--trials", "200", "--evaluations", "0")
    judging = train("--trials", "200")
    assert idle.result()["epochs"] == []
    assert len(judging.result()["epochs"]) >= 3
    assert FOLLOWS not in judging.log.read_text()
