"""What a client sends, names or begins costs the server a bounded amount of memory."""

import os
import shutil
import subprocess
import sys
import tracemalloc
from collections.abc import Callable
from contextlib import ExitStack, closing
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from processes import Processes, RunningServer
from zenoh_wire import changed_on_the_way

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import MAX_MESSAGE_BYTES, Invalid, TaskSpec, task_key
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import Event, SqliteLog
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.intake import Intake
from crkr.server.queries.queue import busy
from crkr.server.queries.refusals import Refuser
from crkr.server.session import open_session
from crkr.server.verbs.rollback import read_rollback
from crkr.server.workers import Workers

Ask = Callable[..., dict[str, Any]]
MIB = 2**20
PATIENCE_S = 60.0


def resident_mib(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


@pytest.mark.parametrize("where", ["rpc/{}", "task/{}/rpc/status", "task/reach/rpc/{}", "task/reach/admin/{}"])
def test_a_long_key_is_refused_and_not_repeated_at_length(where: str, ask: Ask) -> None:
    error = ask(where.format("k" * 30_000))["error"]
    assert error["code"] in ("INVALID", "UNSUPPORTED")
    assert len(error["message"]) < 300


def test_a_long_encoding_is_not_repeated_at_length(ask: Ask) -> None:
    error = ask("task/reach/rpc/status", encoding="text/plain;" + "e" * 200)["error"]
    assert error["code"] == "UNSUPPORTED"
    assert len(error["message"]) < 500


def test_refusals_that_wait_are_bounded_by_bytes_and_large_ones_leave_room_for_small_ones() -> None:
    refuser, error = Refuser(), busy("explain")
    large = [refuser.add(lambda _: None, error, 7 * MIB) for _ in range(10)]
    assert large == [True] * 3 + [False] * 7
    small = sum(refuser.add(lambda _: None, error, 4096) for _ in range(10_000))
    assert small == 16 * MIB // 4096
    while len(refuser):
        refuser.take()
    assert refuser.add(lambda _: None, error, 7 * MIB)


def test_refusals_that_wait_are_bounded_by_their_number() -> None:
    refuser = Refuser()
    assert sum(refuser.add(lambda _: None, busy("explain"), 0) for _ in range(20_000)) == 16_384


def test_a_query_that_not_even_its_refusal_has_room_for_is_let_go_of_at_once(
    free_port: int, plain: Callable[[str], zenoh.Session]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        refuser = Refuser()  # which tells nobody anything
        intake = Intake(session, task_key("*", "*"), {}, Latencies(), refuser)
        intake.start()
        asking, payload = plain(endpoint), bytes(7 * MIB)
        waiting = [
            asking.get(task_key("reach", "dance"), zenoh.handlers.FifoChannel(1), payload=payload, timeout=PATIENCE_S)
            for _ in range(5)
        ]
        for replies in waiting[3:]:  # ended, without a word
            with pytest.raises(zenoh.ZError):
                replies.recv()
        assert [replies.try_recv() for replies in waiting[:3]] == [None] * 3
        refuser.start()
        assert all(replies.recv().err is not None for replies in waiting[:3])
        refuser.close(1.0)


def test_open_trials_of_made_up_workers_are_bounded_in_all_and_honest_ones_stay() -> None:
    workers, rng = Workers(), np.random.default_rng(3)
    honest = [rng.bytes(16) for _ in range(5)]
    workers.asked("reach", "ada", honest)
    tracemalloc.start()
    try:
        for number in range(30):
            workers.asked("reach", f"eve-{number}", [rng.bytes(16) for _ in range(4096)])
        grown = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    _, opened = workers.totals()["reach"]
    assert opened <= 65_536 < 30 * 4096
    assert grown < 40 * MIB
    found = {entry["id"]: entry["open_trials"] for entry in workers.status("reach")}
    assert sum(found.values()) == opened
    assert found["ada"] == 5
    workers.reported("reach", "ada", honest[:2])
    assert {entry["id"]: entry["open_trials"] for entry in workers.status("reach")}["ada"] == 3


def test_made_up_names_push_out_made_up_names_and_no_worker_that_stands_by_its_token() -> None:
    workers = Workers()
    workers.note_token("reach", "ada", True)
    workers.note_token("reach", "gone", True)
    workers.note_token("reach", "gone", False)
    for number in range(5000):
        workers.asked("reach", f"eve-{number}", [number.to_bytes(16)])
    states, opened = workers.totals()["reach"]
    assert (states["alive"], states["lost"], states["unannounced"]) == (1, 1, 1024)
    assert opened == 1024
    assert sum(entry["open_trials"] for entry in workers.status("reach")) == opened


def test_configure_stores_what_it_understood_and_nothing_else(
    start_server: Callable[..., Any], connect: Callable[[str], Ask], reach: dict[str, Any]
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    junk, kernel = os.urandom(100_000), {"signal_variance": 2.0}
    for changes in ({"kernel": {**kernel, "junk": junk}}, {"kernel": kernel, "junk": junk}):
        assert ask("task/reach/admin/configure", {"changes": changes})["error"]["code"] == "INVALID"
    spec = ask("task/reach/admin/configure", {"changes": {"kernel": kernel, "budget": 15}, "junk": junk})["spec"]
    assert (spec["kernel"]["signal_variance"], spec["budget"]) == (2.0, 15)
    assert all(junk not in file.read_bytes() for file in server.data.iterdir())
    server.process.terminate()
    server.process.wait(PATIENCE_S)
    with closing(SqliteLog(server.data)) as log:
        *_, last = log.reads.read("reach")
    assert isinstance(last, Event)
    assert last.seq == 2
    assert last.body == {"changes": {"kernel": {"signal_variance": 2.0}, "budget": 15}}


def test_a_log_of_large_events_is_read_one_at_a_time(tmp_path: Path, reach: dict[str, Any]) -> None:
    count, size = 24, 2 * MIB
    with closing(SqliteLog(tmp_path)) as log:
        task = ServedTask(TaskSpec.from_dict(reach))
        task.note(log.create(task.created))
        for number in range(count):  # as a version stored them that took unknown fields over
            log.append_event("reach", "configure", {"changes": {"kernel": {"junk": bytes([number]) * size}}})
        tracemalloc.start()
        try:
            assert sum(1 for _ in log.reads.read("reach")) == count + 1
            assert sum(1 for _ in log.reads.blocks("reach", 2, 3, 0, count + 1)) == count + 1
            assert not list(log.reads.rollbacks("reach"))
            assert read_rollback({"to": 1}, task, log.reads).body["ids"] == []
            most = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert most < 8 * size


def test_messages_whose_end_never_comes_are_kept_within_bounds(
    server: RunningServer, plain: Callable[[str], zenoh.Session], connect: Callable[[str], Ask], processes: Processes
) -> None:
    """A last fragment is marked by a missing flag for more."""
    kept: list[int] = []

    def without_ends(batch: bytes) -> bytes | None:
        fragment = batch[0] & 0x1F == 0x06
        kept.append(len(batch))
        return None if fragment and not batch[0] & 0x40 else batch

    before = resident_mib(server.process.pid)
    level = zenoh.Priority
    priorities = [level.REAL_TIME, level.INTERACTIVE_HIGH, level.INTERACTIVE_LOW, level.DATA_HIGH]
    priorities += [level.DATA, level.DATA_LOW, level.BACKGROUND]
    with ExitStack() as stack:
        endpoint = stack.enter_context(changed_on_the_way(server.port, without_ends))
        for _ in range(3):
            hostile = plain(endpoint)
            for priority in priorities:
                hostile.put(
                    "crkr/@v1/x",
                    bytes(30 * MIB),
                    priority=priority,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )
        processes.wait_until(lambda: sum(kept) > 100 * MIB)
        assert connect(server.endpoint)("rpc/info")["protocol"] == 1
        assert resident_mib(server.process.pid) - before < 3 * len(priorities) * 18


def test_the_largest_message_of_the_protocol_passes(server: RunningServer, reach: dict[str, Any]) -> None:
    with Client(server.endpoint) as client, ZenohTransport(Connection.choose(server.endpoint, None)) as transport:
        client.create_task(reach)
        room = MAX_MESSAGE_BYTES - len(msgpack.packb({"trials": b""})) - 4
        with pytest.raises(Invalid, match="trials must be"):
            Rpc(transport, PATIENCE_S).call("crkr/@v1/task/reach/rpc/report", {"trials": bytes(room)}, PATIENCE_S)


def test_an_answer_larger_than_a_message_is_refused_before_the_work(ask: Ask, reach: dict[str, Any]) -> None:
    goal = [{"name": f"g{axis}", "low": -1.0, "high": 1.0} for axis in range(200)]
    ask("rpc/create_task", {**reach, "name": "other-wide", "goal": goal})
    trial = {"id": bytes(16), "state": [0.5, 0.0], "goal": [0.0] * 200, "cost": 0.1, "success": True, "kind": "trial"}
    ask("task/other-wide/rpc/report", {"trials": [trial], "wait": True})
    error = ask("task/other-wide/rpc/predict", {"states": [[0.5, 0.0]] * 4096})["error"]
    assert error["code"] == "INVALID"
    most = error["details"]["most"]
    assert len(ask("task/other-wide/rpc/predict", {"states": [[0.5, 0.0]] * most})["trial_ids"]) == most


def test_what_a_server_tells_of_itself_is_what_runs_also_while_the_package_is_replaced(
    tmp_path: Path, free_port: int, connect: Callable[[str], Ask]
) -> None:
    """Another description of the package stands before the installed one, and is taken away under the server."""
    installed = Path(str(distribution("crkr").locate_file("."))) / f"crkr-{distribution('crkr').version}.dist-info"
    described = tmp_path / "path" / "crkr-77.0.dist-info"
    shutil.copytree(installed, described)
    metadata = described / "METADATA"
    metadata.write_text(metadata.read_text().replace(f"Version: {distribution('crkr').version}", "Version: 77.0", 1))
    endpoint = f"tcp/127.0.0.1:{free_port}"
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(tmp_path / "data")]
    environment = {**os.environ, "PYTHONPATH": str(described.parent)}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None
            assert "listening on" in process.stderr.readline()
            ask = connect(endpoint)
            assert ask("rpc/info")["version"] == "77.0"
            shutil.rmtree(described)
            assert ask("rpc/info")["version"] == "77.0"
        finally:
            process.terminate()
