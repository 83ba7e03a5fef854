"""One thread is always at work, whatever becomes of those that block."""

import threading

import pytest
from processes import Processes

from crkr.server.queries.standby_thread import StandbyThread


class BlockingWork:
    """Work that takes a task at a time from a list, and is blocked by those that wait for `let_go`."""

    def __init__(self, tasks: list[str]) -> None:
        self.tasks = tasks
        self.done: list[tuple[int, str]] = []
        self.let_go = threading.Event()
        self.ended: list[int] = []
        self.standby = StandbyThread(self.run, "work")

    def run(self, turn: int) -> None:
        goes_on = True
        while goes_on and self.tasks:
            task = self.tasks.pop(0)
            self.standby.begin(turn)
            if task == "stuck":
                self.let_go.wait(30)
            self.done.append((turn, task))
            goes_on = self.standby.end(turn)
        self.ended.append(turn)


def until(processes: Processes, work: BlockingWork, count: int) -> None:
    processes.wait_until(lambda: len(work.done) == count)


def test_another_thread_replaces_one_that_blocks(processes: Processes) -> None:
    work = BlockingWork(["a", "stuck", "b", "stuck", "c"])
    work.standby.start()
    until(processes, work, 3)
    assert work.done == [(1, "a"), (2, "b"), (3, "c")]
    assert work.ended == [3]
    work.let_go.set()
    until(processes, work, 5)
    assert sorted(work.done) == [(1, "a"), (1, "stuck"), (2, "b"), (2, "stuck"), (3, "c")]
    processes.wait_until(lambda: sorted(work.ended) == [1, 2, 3])  # those that were blocked take nothing more
    work.standby.join(30.0)


def test_the_number_of_blocked_threads_is_bounded(processes: Processes) -> None:
    work = BlockingWork(["stuck"] * 40)
    work.standby.start()
    processes.wait_until(lambda: len(work.tasks) == 24)
    blocked = [thread for thread in threading.enumerate() if thread.name == "work"]
    assert len(blocked) == 16
    blocked[0].join(0.3)  # six times as long as it takes to be replaced
    assert len(work.tasks) == 24
    work.let_go.set()
    until(processes, work, 40)
    work.standby.join(30.0)


@pytest.mark.parametrize("count", [1, 500])
def test_one_that_is_never_held_up_stays_goes_on(count: int, processes: Processes) -> None:
    work = BlockingWork([str(number) for number in range(count)])
    work.standby.start()
    until(processes, work, count)
    assert {turn for turn, _ in work.done} == {1}
    work.standby.join(30.0)
