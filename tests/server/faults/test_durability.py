"""Real servers are killed, stopped, starved and given damaged data: what was acknowledged is there, once."""

import signal
import socket
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Start = Callable[..., Any]
Numbers = Callable[[Any], np.ndarray[Any, Any]]
REPORT = "crkr/@v1/task/reach/rpc/report"


def samples(ask: Ask) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    after: int | None = 0
    while after is not None:
        page = ask("task/reach/rpc/samples", {"after": after, "limit": 10_000})
        found += page["samples"]
        after = page["next"]
    return found


def reported(session: zenoh.Session, trial: dict[str, Any]) -> bool | None:
    """True: acknowledged, None: no answer, so that the outcome is unknown. A refusal fails the test."""
    try:
        reply = session.get(
            REPORT,
            zenoh.handlers.FifoChannel(4),
            payload=msgpack.packb({"trials": [trial]}),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=2.0,
        ).recv()
    except zenoh.ZError:
        return None
    if reply.ok is not None:
        return True
    assert reply.err is not None
    payload = reply.err.payload.to_bytes()
    assert payload == b"Timeout" or msgpack.unpackb(payload)["code"] == "SHUTTING_DOWN"
    return None


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_what_was_acknowledged_is_there_once_after_the_server_was_stopped_under_load(
    how: signal.Signals,
    place: Path | str,
    start_server: Start,
    connect: Callable[[str], Ask],
    plain: Callable[[str], zenoh.Session],
    make_trial: MakeTrial,
    reach: dict[str, Any],
) -> None:
    server = start_server(data=place)
    connect(server.endpoint)("rpc/create_task", reach)
    acknowledged: list[list[bytes]] = [[], [], []]
    unknown: list[bytes] = []
    enough = threading.Barrier(4, timeout=30)

    def load(part: int) -> None:
        session, number = plain(server.endpoint), part
        while True:
            trial = make_trial(number)
            if reported(session, trial) is None:
                unknown.append(trial["id"])
                return
            acknowledged[part].append(trial["id"])
            number += 3
            if len(acknowledged[part]) == 50:
                enough.wait()

    threads = [threading.Thread(target=load, args=(part,)) for part in range(3)]
    for thread in threads:
        thread.start()
    enough.wait()
    server.process.send_signal(how)
    assert server.process.wait(timeout=60) == (0 if how == signal.SIGTERM else -signal.SIGKILL)
    for thread in threads:
        thread.join(timeout=60)

    ask = connect(start_server(data=place).endpoint)
    stored = samples(ask)
    ids = [sample["id"] for sample in stored]
    promised = {one for part in acknowledged for one in part}
    assert len(ids) == len(set(ids))
    assert promised <= set(ids) <= promised | set(unknown)
    assert [sample["seq"] for sample in stored] == list(range(2, len(ids) + 2))
    for sample in stored[:: max(1, len(stored) // 20)]:
        trial = make_trial(int.from_bytes(sample["id"], "big") - 1)
        assert sample["cost"] == trial["cost"]
        assert np.frombuffer(sample["state"]["data"], "<f8").tolist() == trial["state"]


def test_a_restarted_server_answers_as_before(
    place: Path | str,
    start_server: Start,
    connect: Callable[[str], Ask],
    make_trial: MakeTrial,
    reach: dict[str, Any],
    numbers: Numbers,
) -> None:
    server = start_server(data=place)
    ask = connect(server.endpoint)
    ask("rpc/create_task", reach)
    kinds = ["demonstration", "trial", "trial", "evaluation", "trial"]
    trials = [make_trial(n, kind=kinds[n % 5], success=n % 7 != 0) for n in range(150)]
    for first in range(0, 150, 30):
        ask("task/reach/rpc/report", {"trials": trials[first : first + 30]})
    ask("task/reach/admin/recost", {"ids": [trials[3]["id"]], "costs": [0.5]})
    ask("task/reach/admin/remove", {"ids": [trials[5]["id"], trials[6]["id"]]})
    ask("task/reach/admin/refit")
    ask("task/reach/admin/configure", {"changes": {"budget": 15}})
    ask("task/reach/rpc/report", {"trials": [make_trial(200)], "wait": True})

    def answers(ask: Ask) -> tuple[Any, ...]:
        states = np.random.default_rng(1).uniform([0, -1], [1, 1], (20, 2)).tolist()
        ids = [bytes([n] * 16) for n in range(20)]
        asked = [{"states": states, "explore": explore, "trial_ids": ids} for explore in (False, True)]
        predictions = [ask("task/reach/rpc/predict", message) for message in asked]
        found = [numbers(p[name]) for p in predictions for name in ("goals", "means", "sigmas", "novelty")]
        status = ask("task/reach/rpc/status")
        kept = {name: status[name] for name in ("samples", "eligible", "active", "seq", "model_version")}
        return np.concatenate([one.ravel() for one in found]), ask("task/reach/rpc/model")["ids"], kept, samples(ask)

    before = answers(ask)
    server.process.kill()
    server.process.wait(timeout=60)
    after = answers(connect(start_server(data=place).endpoint))
    np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-9)
    assert after[1:] == before[1:]


def run_server(*options: str) -> tuple[int, str]:
    """A server that is expected to refuse: its exit status and what it said."""
    command = [sys.executable, "-m", "crkr.client", "server", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    return done.returncode, done.stderr


def refusal(*options: str) -> str:
    """The one line that a refusing server prints."""
    status, said = run_server(*options)
    assert status == 1, said
    assert said.count("\n") == 1, said
    line = said.strip()
    assert line.startswith("error: ")
    return line


def test_a_second_server_refuses_the_data_directory_and_the_port(start_server: Start, tmp_path: Path) -> None:
    server = start_server()
    line = refusal("--data", str(server.data), "--listen", "tcp/127.0.0.1:0")
    assert str(server.process.pid) in line
    assert "in use" in line
    line = refusal("--data", str(tmp_path / "other"), "--listen", server.endpoint)
    assert server.endpoint in line
    assert "the port is in use" in line
    (server.data / "lock").unlink()  # it looks stale
    assert "in use by another process" in refusal("--data", str(server.data), "--listen", "tcp/127.0.0.1:0")


def test_a_server_that_cannot_start_says_why_in_one_line_and_leaves(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    line = refusal("--data", str(tmp_path / "file" / "data"), "--listen", "tcp/127.0.0.1:0")
    assert "cannot be written" in line
    with sqlite3.connect(tmp_path / "crkr.sqlite3") as connection:
        connection.execute("PRAGMA user_version = 99")
    connection.close()
    line = refusal("--data", str(tmp_path), "--listen", "tcp/127.0.0.1:0")
    assert "99" in line
    assert "newer" in line
    assert "nonsense" in refusal("--data", str(tmp_path / "data"), "--listen", "nonsense")


def test_the_port_is_free_again_at_once(start_server: Start, free_port: int) -> None:
    for _ in range(2):
        server = start_server(port=free_port)
        server.process.terminate()
        assert server.process.wait(timeout=60) == 0
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", free_port))
