"""Of a relay's threads one is on duty, whatever becomes of the others."""

import threading
from typing import Any

import pytest

from crkr.server.queries.standby_thread import StandbyThread


class Desk:
    """Work that takes a task at a time from a list, and is held up by those that wait for `let_go`."""

    def __init__(self, tasks: list[str]) -> None:
        self.tasks = tasks
        self.done: list[tuple[int, str]] = []
        self.let_go = threading.Event()
        self.ended: list[int] = []
        self.relay = StandbyThread(self.work, "desk")

    def work(self, turn: int) -> None:
        on_duty = True
        while on_duty and self.tasks:
            task = self.tasks.pop(0)
            self.relay.begin(turn)
            if task == "stuck":
                self.let_go.wait(30)
            self.done.append((turn, task))
            on_duty = self.relay.end(turn)
        self.ended.append(turn)


def until(processes: Any, desk: Desk, count: int) -> None:
    processes.wait_until(lambda: len(desk.done) == count)


def test_another_thread_takes_over_from_one_that_is_held_up(processes: Any) -> None:
    desk = Desk(["a", "stuck", "b", "stuck", "c"])
    desk.relay.start()
    until(processes, desk, 3)
    assert desk.done == [(1, "a"), (2, "b"), (3, "c")]
    assert desk.ended == [3]
    desk.let_go.set()
    until(processes, desk, 5)
    assert sorted(desk.done) == [(1, "a"), (1, "stuck"), (2, "b"), (2, "stuck"), (3, "c")]
    processes.wait_until(lambda: sorted(desk.ended) == [1, 2, 3])  # those that were held up took nothing more
    desk.relay.join(30.0)


def test_no_more_threads_are_held_up_than_a_bounded_number(processes: Any) -> None:
    desk = Desk(["stuck"] * 40)
    desk.relay.start()
    processes.wait_until(lambda: len(desk.tasks) == 24)
    assert not threading.Event().wait(0.3)  # six times the relay's patience
    assert len(desk.tasks) == 24
    desk.let_go.set()
    until(processes, desk, 40)
    desk.relay.join(30.0)


@pytest.mark.parametrize("count", [1, 500])
def test_one_that_is_never_held_up_stays_on_duty(count: int, processes: Any) -> None:
    desk = Desk([str(number) for number in range(count)])
    desk.relay.start()
    until(processes, desk, count)
    assert {turn for turn, _ in desk.done} == {1}
    desk.relay.join(30.0)
