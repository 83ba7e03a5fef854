"""One task's learning does not hold up another's."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.protocol import Internal, TaskSpec, Trial
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.thread import Learning
from crkr.server.log import Event, LoggedTrial

Ask = Callable[..., dict[str, Any]]
AXIS = [{"name": "x", "low": -1.0, "high": 1.0}]
PATIENCE_S = 30.0


@pytest.fixture
def learning() -> Iterator[Learning]:
    made = Learning(lambda *_: None, lambda _: None, lambda _: None)
    yield made
    made.close(PATIENCE_S)


def task(name: str) -> ServedTask:
    return ServedTask(TaskSpec.from_dict({"name": name, "state": AXIS, "goal": AXIS}))


def spend(seconds: float) -> None:
    """Keep the calling thread at work that long."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        pass


def configured(seq: int) -> Event:
    return Event(seq, 0.0, "configure", {"changes": {"budget": seq}})


def test_tasks_take_turns_and_each_keeps_the_order_of_its_log(learning: Learning) -> None:
    one, other = task("one"), task("other")
    order: list[tuple[str, int]] = []
    over = threading.Event()

    def note(name: str, seq: int) -> Callable[[Any, Exception | None], None]:
        def noted(_result: Any, failure: Exception | None) -> None:
            assert failure is None
            order.append((name, seq))
            if len(order) == 7:
                over.set()

        return noted

    for seq in range(2, 7):
        learning.submit(one, configured(seq), note("one", seq))
    for seq in (2, 3):
        learning.submit(other, configured(seq), note("other", seq))
    learning.start()
    assert over.wait(PATIENCE_S)
    assert [seq for name, seq in order if name == "one"] == [2, 3, 4, 5, 6]
    assert order.index(("other", 3)) < order.index(("one", 5))
    assert (one.spec.budget, other.spec.budget) == (6, 3)


def test_trials_of_one_task_are_learned_in_one_step_whatever_other_tasks_do_between() -> None:
    one, other = task("one"), task("other")
    models: dict[str, list[int]] = {"one": [], "other": []}
    learning = Learning(lambda of, _, after: models[of.name].append(after.version), lambda _: None, lambda _: None)
    over = threading.Semaphore(0)
    for seq in range(2, 12):
        learning.submit(one, [LoggedTrial(seq, 0.0, trial(one, seq))])
        learning.submit(one, ())  # as a change that changes nothing, and a report of what is known
        learning.submit(other, configured(seq))
    learning.submit(one, configured(12))  # this one has its place between trials of its own task
    for seq in range(13, 23):
        learning.submit(one, [LoggedTrial(seq, 0.0, trial(one, seq))])
    for each in (one, other):
        learning.submit(each, (), lambda *_: over.release())
    learning.start()
    for _ in range(2):
        assert over.acquire(timeout=PATIENCE_S)
    assert learning.close(PATIENCE_S)
    assert models == {"one": [11, 12, 22], "other": list(range(2, 12))}
    assert (one.spec.budget, one.eligible) == (12, 20)


def test_trials_of_several_robots_share_a_step_and_those_of_one_are_learned_at_once() -> None:
    one = task("one")
    models: list[int] = []
    learned, told = threading.Semaphore(0), threading.Semaphore(0)

    def note(_task: ServedTask, _before: Any, after: Any) -> None:
        models.append(after.version)
        learned.release()

    paced = Learning(note, lambda _: None, lambda _: None, pace_s=1e6)

    def report(seq: int, worker: str, done: Callable[..., None] | None = None) -> None:
        paced.submit(one, [LoggedTrial(seq, 0.0, replace(trial(one, seq), worker=worker))], done)

    paced.start()
    for seq in range(2, 6):
        report(seq, "a")
        assert learned.acquire(timeout=PATIENCE_S)
    for seq, worker in enumerate("bcd", 6):
        report(seq, worker)
    report(9, "e", lambda *_: told.release())  # as with `wait`: those before it need not wait either
    assert told.acquire(timeout=PATIENCE_S)
    assert learned.acquire(timeout=PATIENCE_S)
    for seq in range(10, 74):  # as many as a step takes at most
        report(seq, "f")
    assert learned.acquire(timeout=PATIENCE_S)
    report(74, "g")
    assert paced.close(PATIENCE_S)
    assert models == [2, 3, 4, 5, 9, 73]


def test_a_change_to_a_long_log_leaves_the_other_tasks_a_thread(learning: Learning) -> None:
    long, other = task("long"), task("other")
    long.seq = 1_000_000
    learned, told = threading.Event(), threading.Event()

    def while_it_goes_on(_result: Any, _failure: Exception | None) -> None:
        if learned.wait(PATIENCE_S):
            told.set()

    learning.submit(long, configured(2), while_it_goes_on)
    learning.start()
    learning.submit(other, configured(2), lambda *_: learned.set())
    assert told.wait(PATIENCE_S)


def test_a_question_between_long_steps_does_not_bring_them_before_those_of_other_tasks(learning: Learning) -> None:
    long, threads = task("long"), list[str]()
    told = threading.Semaphore(0)

    def note(_result: Any, _failure: Exception | None) -> None:
        threads.append(threading.current_thread().name)
        if len(threads) == 1:
            spend(0.06)
        told.release()

    learning.start()
    for entries in (configured(2), (), configured(3)):  # the second, as an explanation of a sample
        learning.submit(long, entries, note)
        assert told.acquire(timeout=PATIENCE_S)
    assert threads == ["learning", "long learning", "long learning"]


def test_a_task_that_cannot_learn_stops_alone_and_its_thread_goes_on(learning: Learning) -> None:
    one, other = task("one"), task("other")
    failures: list[Exception | None] = []
    over = threading.Event()

    def panics(_result: Any, failure: Exception | None) -> None:
        failures.append(failure)
        raise KeyboardInterrupt  # as a panic in a binding, no Exception

    learning.submit(one, Event(2, 0.0, "configure", {"changes": {"budget": -1}}), panics)
    learning.submit(one, [LoggedTrial(3, 0.0, trial(one))], panics)
    learning.submit(other, configured(2), lambda *_: over.set())
    learning.start()
    assert over.wait(PATIENCE_S)
    learning.submit(one, (), lambda *_: over.clear())
    learning.close(PATIENCE_S)
    assert all(isinstance(failure, Internal) for failure in failures)
    assert "budget" in one.fault
    assert other.fault == ""


def trial(of: ServedTask, number: int = 1) -> Trial:
    return Trial.create(of.spec, id=UUID(int=number), state=[0.1], goal=[0.2], cost=0.1, success=True)


def test_a_report_is_waited_for_only_as_long_as_its_own_task_takes(
    ask: Ask, reach: dict[str, Any], make_trial: Callable[..., dict[str, Any]], new_id: Callable[[], bytes]
) -> None:
    busy = f"other-{UUID(bytes=new_id())}"
    ask("rpc/create_task", {**reach, "name": busy, "budget": 2000})
    for first in range(0, 4000, 1000):
        ask(f"task/{busy}/rpc/report", {"trials": [make_trial(number) for number in range(first, first + 1000)]})
    assert ask("task/reach/rpc/report", {"trials": [make_trial(1)], "wait": True})["model_version"] == 2
    status = ask(f"task/{busy}/rpc/status")
    assert status["model_version"] < status["seq"]


def test_numbers_that_would_break_arithmetic_are_refused_at_creation_and_change(
    ask: Ask, reach: dict[str, Any]
) -> None:
    small = {"kernel": {"signal_variance": 1e-310}}
    error = ask("rpc/create_task", {**reach, "name": "absurd", **small})["error"]
    assert (error["code"], error["details"]) == ("INVALID", {"field": "kernel.signal_variance"})
    for changes in (small, {"budget": 5001}, {"noise_floor": 1e-100}, {"kernel": {"junk": bytes(10_000)}}):
        error = ask("task/reach/admin/configure", {"changes": changes})["error"]
        assert error["code"] == "INVALID"
        assert len(error["message"]) < 1000
    assert ask("task/reach/rpc/status")["seq"] == 1
    assert ask("task/reach/admin/configure", {"changes": {"budget": 30, "kernel": {"linear_weight": 0.5}}})["seq"] == 2


def test_the_selector_that_keeps_everything_says_where_it_stops(ask: Ask, reach: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    ask("rpc/create_task", {**reach, "name": "other-everything", "selector": "full"})
    ids = [UUID(int=number + 1).bytes for number in range(3100)]
    for first in range(0, 3100, 775):
        trials = [
            {
                "id": one,
                "state": rng.uniform(size=2).tolist(),
                "goal": [0.0] * 3,
                "cost": 0.5,
                "success": True,
                "kind": "trial",
            }
            for one in ids[first : first + 775]
        ]
        ask("task/other-everything/rpc/report", {"trials": trials, "wait": True})
    status = ask("task/other-everything/rpc/status")
    assert (status["active"], status["eligible"]) == (3000, 3100)
    [message] = [advice["message"] for advice in status["advice"] if advice["code"] == "full"]
    assert "3000" in message
    ask("task/other-everything/admin/remove", {"ids": ids[:150]})
    assert "full" not in [advice["code"] for advice in ask("task/other-everything/rpc/status").get("advice", [])]


def test_what_waits_is_counted_for_each_task(learning: Learning) -> None:
    one, other = task("one"), task("other")
    learning.submit(one, [LoggedTrial(2, 0.0, trial(one))], lambda *_: None)
    learning.submit(one, configured(3))
    assert (learning.waiting(one), learning.waiting(other)) == ((1, 1), (0, 0))
    assert (learning.backlog, learning.asked) == (1, 1)
    over = threading.Event()
    learning.submit(one, (), lambda *_: over.set())
    learning.start()
    assert over.wait(PATIENCE_S)
    assert learning.waiting(one) == (0, 0)
    assert (learning.backlog, learning.asked) == (0, 0)
