"""A local copy of a policy answers as the server does, follows it, goes on without it, and says how old it is."""

import itertools
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from named_threads import raise_in, thread_named
from processes import Processes
from putt_task import IDS, PROBES, assert_alike, practise, specification

from crkr.client import Client, Task
from crkr.client.mirror import Mirror
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.protocol import (
    Invalid,
    NoSamples,
    NovelState,
    Unavailable,
    UnknownTask,
)

PATIENCE_S = 20.0


@pytest.fixture
def client(shared_endpoint: str) -> Iterator[Client]:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        yield client


@pytest.mark.parametrize("explore", [False, True])
@pytest.mark.parametrize("settings", [{}, {"budget": 15, "kernel": {"signal_variance": 2.0, "linear_weight": 0.3}}])
def test_it_answers_as_the_task_does(client: Client, explore: bool, settings: dict[str, Any]) -> None:
    task = client.create_task(specification(**settings))
    practise(task, 60, 2)
    with task.mirror() as mirror:
        assert_alike(mirror.predict(PROBES, explore, trial_ids=IDS), task.predict(PROBES, explore, trial_ids=IDS))
        one = mirror.predict(PROBES[0], explore, trial_ids=IDS[:1])
        assert_alike(one, task.predict(PROBES[0], explore, trial_ids=IDS[:1]))
        assert one.goals.shape == (3,)


def test_it_follows_the_model_by_notices(client: Client) -> None:
    task = client.create_task(specification())
    with task.mirror(every_s=1000.0, pause_s=0.01) as mirror:
        for round_ in range(5):
            seq = practise(task, 10, round_)
            mirror.wait_for(seq, PATIENCE_S)
            assert mirror.model_version == seq
            assert_alike(mirror.predict(PROBES, True, trial_ids=IDS), task.predict(PROBES, True, trial_ids=IDS))


def test_it_takes_over_changes_that_add_no_sample(client: Client) -> None:
    task = client.create_task(specification())
    practise(task, 20, 3)
    with task.mirror() as mirror:
        for change in ({"explore_scale": 0.5}, {"kernel": {"signal_variance": 3.0}}, {"budget": 5}):
            answer = task.configure(change)
            mirror.wait_for(answer["seq"], PATIENCE_S)
            assert_alike(mirror.predict(PROBES, True, trial_ids=IDS), task.predict(PROBES, True, trial_ids=IDS))


def test_a_prediction_of_it_may_be_reported_and_makes_ids_of_its_own(client: Client) -> None:
    task = client.create_task(specification())
    practise(task, 20, 3)
    with task.mirror() as mirror:
        answer = mirror.predict(PROBES[0], explore=True)
        assert len({answer.trial_id, mirror.predict(PROBES[0], explore=True).trial_id}) == 2
        assert len(set(mirror.predict(PROBES, explore=True).trial_ids)) == len(PROBES)
        receipt = task.report(answer, cost=0.5, success=True, wait=True)
        mirror.wait_for(receipt.seqs[-1], PATIENCE_S)
        assert answer.trial_id in mirror.model.ids


def test_without_samples_it_refuses_and_then_learns_of_the_first(client: Client) -> None:
    task = client.create_task(specification())
    with task.mirror() as mirror:
        with pytest.raises(NoSamples):
            mirror.predict(PROBES[0])
        mirror.wait_for(practise(task, 1, 4), PATIENCE_S)
        assert mirror.predict(PROBES[0]).active == 1


def test_errors_are_those_of_the_task(client: Client) -> None:
    task = client.create_task(specification(novel="refuse", novelty_limit=0.5))
    practise(task, 20, 3)
    with task.mirror() as mirror:
        two: tuple[Task, Mirror] = (task, mirror)
        bad: list[tuple[object, type[Exception]]] = [
            ([1.0], Invalid),
            ([np.nan, 0.0], Invalid),
            ("north", Invalid),
            ([50.0, 50.0], NovelState),
        ]
        for states, error in bad:
            for policy in two:
                with pytest.raises(error):
                    policy.predict(states)
    with pytest.raises(UnknownTask):
        client.task("nowhere").mirror()


@pytest.mark.parametrize("name", ["every_s", "pause_s", "max_age_s"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_times_that_make_no_sense_are_refused(client: Client, name: str, value: float) -> None:
    task = client.create_task(specification())
    with pytest.raises(Invalid, match=name):
        task.mirror(**{name: value})


def test_a_copy_that_must_be_young_is_asked_about_often_enough(client: Client, processes: Processes) -> None:
    task = client.create_task(specification())
    practise(task, 5, 3)
    with task.mirror(every_s=1000.0, pause_s=1000.0, max_age_s=0.3) as mirror:
        for _ in range(3):
            asked = time.monotonic()
            processes.wait_until(lambda asked=asked: time.monotonic() - mirror.age_s > asked)


def test_a_closed_one_answers_no_more(client: Client) -> None:
    task = client.create_task(specification())
    practise(task, 5, 3)
    mirror = task.mirror()
    mirror.close()
    mirror.close()
    for call in (lambda: mirror.predict(PROBES[0]), mirror.refresh, lambda: mirror.wait_for(10**6, PATIENCE_S)):
        with pytest.raises(Unavailable):
            call()


def test_its_thread_ends_with_the_client_and_the_copy_says_that_it_is_not_refreshed(shared_endpoint: str) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        mirror = client.create_task(specification()).mirror(every_s=0.05, pause_s=0.01)
        thread = thread_named(f"crkr-mirror-{mirror.name}")
    thread.join(PATIENCE_S)
    assert not thread.is_alive()
    assert mirror.fault is not None
    assert "closed" in mirror.fault.message
    with pytest.raises(Unavailable):
        mirror.refresh()


def test_where_outcomes_guide_the_task_it_says_that_it_answers_plainly(client: Client) -> None:
    outcome = [{"name": "miss", "unit": "m", "target": 0.0, "tolerance": 0.01, "group": "all"}]
    task = client.create_task(specification(outcome=outcome))
    rng = np.random.default_rng(5)
    states, goals = rng.uniform(0, 1, (60, 2)), rng.uniform(-0.9, 0.9, (60, 3))
    task.report(state=states, goal=goals, cost=0.2, success=True, outcome=goals[:, :1] - 0.3, wait=True)
    with task.mirror() as mirror:
        theirs, ours = task.predict(PROBES), mirror.predict(PROBES)
        assert (theirs.policy, ours.policy) == ("corrected", "mean")
        np.testing.assert_allclose(ours.means, theirs.means, rtol=0, atol=1e-9)
        assert ours.predicted_outcome is None


def test_threads_may_predict_while_it_is_refreshed(client: Client) -> None:
    task = client.create_task(specification(budget=30))
    practise(task, 10, 0)
    failures: list[BaseException] = []
    done = threading.Event()

    with task.mirror(pause_s=0.001) as mirror:

        def ask() -> None:
            try:
                while not done.is_set():
                    answer = mirror.predict(PROBES, True, trial_ids=IDS)
                    again = mirror.model
                    if again.version == answer.model_version:
                        np.testing.assert_array_equal(again.predict(PROBES, True, IDS).goals, answer.goals)
            except BaseException as error:  # told to the test
                failures.append(error)

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        for round_ in range(30):
            seq = practise(task, 3, round_)
        mirror.wait_for(seq, PATIENCE_S)
        done.set()
        for thread in threads:
            thread.join(PATIENCE_S)
    assert not failures


def complaint(mirror: Mirror) -> str:
    """Why a refresh fails now."""
    with pytest.raises(Unavailable) as caught:
        mirror.refresh(0.2)
    return caught.value.message


def test_a_refresh_ends_by_its_deadline_while_another_waits_for_a_server_that_stands_still(
    start_server: Callable[..., Any], processes: Processes
) -> None:
    server = start_server()
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(specification())
        practise(task, 5, 1)
        with task.mirror(every_s=1000.0, pause_s=1000.0) as mirror, ThreadPoolExecutor(1) as pool:
            server.process.send_signal(signal.SIGSTOP)
            try:
                waiting = pool.submit(mirror.refresh, PATIENCE_S)
                processes.wait_until(lambda: "another refresh" in complaint(mirror))
                assert not waiting.done()
            finally:
                server.process.send_signal(signal.SIGCONT)
            assert not waiting.result(PATIENCE_S)
            for time_s in (0.0, float("nan"), float("inf")):
                with pytest.raises(Invalid, match="timeout_s"):
                    mirror.wait_for(1, time_s)


@pytest.mark.parametrize("order", list(itertools.permutations(("client", "mirror", "outbox"))))
def test_client_mirror_and_outbox_may_be_closed_in_any_order(
    shared_endpoint: str, tmp_path: Path, processes: Processes, order: tuple[str, ...]
) -> None:
    client = Client(shared_endpoint, timeout_s=30.0)
    task = client.create_task(specification())
    practise(task, 5, 1)
    open_ones: dict[str, Any] = {"client": client, "mirror": task.mirror(), "outbox": task.outbox(tmp_path / "box")}
    for name in order:
        open_ones[name].close()
    processes.wait_until(lambda: not [thread for thread in threading.enumerate() if thread.name.endswith(task.name)])


def test_an_unreadable_notice_does_not_end_refreshing(client: Client) -> None:
    task = client.create_task(specification())
    practise(task, 10, 1)
    transport = ZenohTransport(Connection.choose(client.endpoint, None))
    with transport, task.mirror(every_s=0.1, pause_s=0.01) as mirror:
        transport.connect(time.monotonic() + PATIENCE_S)
        for depth in (65, 1000):
            notice = b"\x81\xa1a" + b"\x91" * depth + b"\xc0"
            transport.publish(f"crkr/@v1/task/{task.name}/pub/model", "model", notice)
        for round_ in (2, 3):
            mirror.wait_for(practise(task, 10, round_), PATIENCE_S)
        assert mirror.defects == 0


class Panic(BaseException):
    """As the panic of a binding to Rust, which is no Exception."""


@pytest.mark.parametrize("raised", [RecursionError, MemoryError, SystemExit, Panic])
def test_whatever_is_raised_in_its_thread_is_told_and_it_goes_on(
    client: Client, processes: Processes, raised: type[BaseException]
) -> None:
    task = client.create_task(specification())
    practise(task, 10, 1)
    with task.mirror(every_s=0.1, pause_s=0.01) as mirror:
        raise_in(f"crkr-mirror-{task.name}", raised)
        processes.wait_until(lambda: mirror.defects == 1)
        assert "defects=1" in repr(mirror)
        mirror.wait_for(practise(task, 10, 2), PATIENCE_S)
        processes.wait_until(lambda: mirror.fault is None)
