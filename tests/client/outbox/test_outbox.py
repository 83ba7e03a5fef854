"""What an outbox took is stored by the server once: after lost links, restarts of either side, and refused trials."""

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from small_tasks import put, stored, task_spec

from crkr.client import Client, Outbox, Task
from crkr.protocol import Conflict, Invalid, StorageError, Unavailable
from crkr.protocol.trial import MAX_INFO_BYTES

PATIENCE_S = 30.0
Start = Callable[..., Any]


@pytest.fixture
def task(shared_endpoint: str) -> Iterator[Task]:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        yield client.create_task(task_spec(f"lob-{uuid4()}"))


def test_what_is_reported_arrives_in_order_and_once(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 600)
        ids += outbox.report(state=np.zeros((300, 2)), goal=np.zeros((300, 2)), cost=0.1, success=True)
        outbox.flush(PATIENCE_S)
        assert (outbox.pending, outbox.refused(), outbox.fault) == (0, [], None)
        assert stored(task) == ids


def test_trials_arrive_as_they_were_reported(task: Task, tmp_path: Path) -> None:
    fields: dict[str, Any] = {
        "state": [0.1, 0.7],
        "goal": [-0.3, 1.0],
        "cost": 0.25,
        "success": True,
        "kind": "demonstration",
        "worker": "left arm",
        "model_version": 3,
        "info": {"note": "von Hand", "list": [1, 2.5, None]},
    }
    with task.outbox(tmp_path / "box") as outbox:
        [identity] = outbox.report(**fields)
        outbox.flush(PATIENCE_S)
    [entry] = task.iter_samples()
    assert task.report(**fields, id=identity).duplicates == 1
    assert (entry.trial.kind, entry.trial.worker, entry.trial.info) == ("demonstration", "left arm", fields["info"])


def test_an_answer_of_predict_is_reported_under_its_id(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        put(outbox, 30)
        outbox.flush(PATIENCE_S)
        answer = task.predict([0.5, 0.5], explore=True)
        assert outbox.report(answer, cost=0.1, success=True) == (answer.trial_id,)
        outbox.flush(PATIENCE_S)
    assert stored(task)[-1] == answer.trial_id


def test_without_a_server_reports_are_kept_and_the_next_outbox_delivers_them(
    start_server: Start, free_port: int, tmp_path: Path
) -> None:
    server = start_server(port=free_port)
    with Client(server.endpoint, timeout_s=PATIENCE_S) as client:
        client.create_task(task_spec("lob"))
        client.task("lob").outbox(tmp_path / "box").close()
    server.process.terminate()
    server.process.wait()

    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        ids = put(outbox, 40)
        with pytest.raises(Unavailable, match="40 trials are still in the outbox"):
            outbox.flush(0.5)
        assert outbox.pending == 40

    start_server(port=free_port)
    with Client(server.endpoint) as client, client.task("lob").outbox(tmp_path / "box") as outbox:
        outbox.flush(PATIENCE_S)
        assert stored(client.task("lob")) == ids


def test_a_new_file_needs_a_server_once(free_port: int, tmp_path: Path) -> None:
    with Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.3) as client:
        for _ in range(2):
            with pytest.raises(Unavailable):
                client.task("lob").outbox(tmp_path / "box")


def test_a_trial_that_is_refused_is_put_aside_and_the_others_arrive(task: Task, tmp_path: Path) -> None:
    taken = uuid4()
    task.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.9, success=True, id=taken)
    with task.outbox(tmp_path / "box") as outbox:
        before = put(outbox, 100, 1)
        outbox.report(state=[0.0, 0.0], goal=[0.0, 0.0], cost=0.1, success=True, id=taken)
        after = put(outbox, 100, 2)
        outbox.flush(PATIENCE_S)
        [refused] = outbox.refused()
        assert (refused.id, refused.error.split(":")[0], refused.trial["cost"]) == (taken, "CONFLICT", 0.1)
        assert stored(task) == [taken, *before, *after]
    with task.outbox(tmp_path / "box") as outbox:
        assert [one.id for one in outbox.refused()] == [taken]
        outbox.discard(outbox.refused())
        assert outbox.refused() == []


def test_what_is_not_valid_is_refused_at_once_and_not_kept(task: Task, tmp_path: Path) -> None:
    good: dict[str, Any] = {"state": [0.1, 0.2], "goal": [0.0, 0.0], "cost": 0.5, "success": True}
    with task.outbox(tmp_path / "box") as outbox:
        for change in ({"goal": [0.0, 2.0]}, {"cost": 1.5}, {"state": [0.1]}, {"state": [0.1, np.nan]}, {"kind": "x"}):
            with pytest.raises(Invalid):
                outbox.report(**{**good, **change})
        assert outbox.pending == 0
        assert repr(outbox) == f"Outbox({str(tmp_path / 'box')!r}, task={task.name!r}, pending=0, fault=None)"
    with pytest.raises(Unavailable, match="closed"):
        outbox.report(**good)
    outbox.close()
    assert stored(task) == []


OTHER = """
import sys
from crkr.client import Client

with Client(sys.argv[1]) as client:
    client.task(sys.argv[2]).outbox(sys.argv[3])
"""


def test_a_file_has_one_outbox_at_a_time_and_one_task(task: Task, shared_endpoint: str, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box"):
        with pytest.raises(StorageError, match="in use already"):
            task.outbox(tmp_path / "box")
        other = subprocess.run(
            [sys.executable, "-c", OTHER, shared_endpoint, task.name, str(tmp_path / "box")],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert "in use already" in other.stderr
    with Client(shared_endpoint, timeout_s=30.0) as client:
        second = client.create_task(task_spec(f"lob-{uuid4()}"))
        with pytest.raises(Conflict, match=task.name):
            second.outbox(tmp_path / "box")


def test_a_directory_that_is_not_there_is_named(task: Task, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="nowhere"):
        task.outbox(tmp_path / "nowhere" / "box")


def test_trials_with_as_much_information_as_is_allowed_arrive(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        info = {"note": "x" * (MAX_INFO_BYTES - 100)}
        ids = outbox.report(state=np.zeros((600, 2)), goal=np.zeros((600, 2)), cost=0.1, success=True, info=info)
        outbox.flush(PATIENCE_S)
        assert outbox.refused() == []
    assert tuple(stored(task)) == ids


def test_times_that_make_no_sense_are_refused(task: Task, tmp_path: Path) -> None:
    with task.outbox(tmp_path / "box") as outbox:
        for time_s in (0.0, -1.0, float("nan"), float("inf")):
            with pytest.raises(Invalid, match="timeout_s"):
                outbox.flush(time_s)


def test_threads_may_close_it_while_others_report(task: Task, tmp_path: Path) -> None:
    """Every acknowledged trial is in the file, and a closed outbox may be opened again."""
    said: list[UUID] = []

    def report(outbox: Outbox) -> None:
        with contextlib.suppress(Unavailable):
            while True:
                said.extend(put(outbox, 1))

    for _ in range(10):
        outbox = task.outbox(tmp_path / "box")
        with ThreadPoolExecutor(5) as pool:
            reporting = [pool.submit(report, outbox) for _ in range(3)]
            for closing in [pool.submit(outbox.close) for _ in range(2)]:
                closing.result(PATIENCE_S)
            task.outbox(tmp_path / "box").close()
            for each in reporting:
                each.result(PATIENCE_S)
    with task.outbox(tmp_path / "box") as outbox:
        outbox.flush(PATIENCE_S)
    assert set(stored(task)) >= set(said)
