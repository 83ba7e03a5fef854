"""Whatever others call themselves, nothing of it acts on the terminal or the log of those who look."""

import os
import pty
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID

import msgpack
import pytest
import zenoh
from processes import Processes, RunningServer

ESCAPES = "\x1b]52;c;eA==\x1b\\\x1b[2J\x9b31m\x7f\u202e\u2028"
NAME = f"[red]evil[/red][/]{ESCAPES}"
FORGED = "\n2026-01-01 00:00:00,000 ERROR crkr.server.log: the log is damaged"
# What would act: the start of a title or clipboard sequence, a cleared screen, a colour, marks of direction and lines.
ACTING = ["\x1b]52", "\x1b[2J\x9b", "\x9b", "\x7f", "\u202e", "\u2028"]
ROOT = "crkr/@v1"
PATIENCE_S = 60.0
AXIS = {"unit": "m" + ESCAPES, "low": 0.0, "high": 1.0}
SPEC = {
    "name": "reach",
    "description": "about " + NAME,
    "state": [{"name": "x" + NAME, **AXIS}],
    "goal": [{"name": "y" + NAME, **AXIS}],
    "outcome": [{"name": "miss" + ESCAPES, "unit": "m" + ESCAPES, "tolerance": 0.1}],
}


def on_terminal(*words: str, until: str | None = None, columns: int = 200) -> str:
    """What a command writes to a terminal, to its end or until it wrote something."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": str(columns), "LINES": "80"}
    command = [sys.executable, "-m", "crkr.client", *words]
    with subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as process:
        os.close(theirs)
        written, deadline = b"", time.monotonic() + PATIENCE_S
        while until is None or until.encode() not in written:
            if not select.select([ours], [], [], max(0.0, deadline - time.monotonic()))[0]:
                process.kill()
                pytest.fail(f"waited in vain for {until!r}: {written!r}")
            try:
                data = os.read(ours, 65536)
            except OSError:  # the command has ended
                break
            written += data
        os.close(ours)
        process.terminate()
    return written.decode()


def acting(written: str) -> list[str]:
    return [found for found in ACTING if found in written]


def configuration(mode: str, endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5(f"{'listen' if mode == 'router' else 'connect'}/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


def ask(session: zenoh.Session, key: str, message: Any) -> Any:
    (reply,) = session.get(f"{ROOT}/{key}", payload=msgpack.packb(message), timeout=20.0)
    assert reply.ok is not None, reply.err and reply.err.payload.to_bytes()
    return msgpack.unpackb(reply.ok.payload.to_bytes())


def trial(number: int) -> dict[str, Any]:
    return {
        "id": UUID(int=number + 1).bytes,
        "state": [0.5],
        "goal": [0.5],
        "cost": 0.5,
        "success": True,
        "kind": "evaluation" if number % 2 else "trial",
        "worker": NAME,
        "info": {"reason": NAME, "epoch": 0, "outcomes": {NAME: True}},
    }


@pytest.fixture
def endpoint(server: RunningServer, processes: Processes) -> Iterator[str]:
    """A server whose task, trials and workers have such names."""
    with zenoh.open(configuration("client", server.endpoint)) as session:
        ask(session, "rpc/create_task", SPEC)
        ask(session, "task/reach/rpc/report", {"trials": [trial(number) for number in range(60)], "wait": True})
        ask(session, "task/reach/rpc/predict", {"states": [0.5], "explore": True, "worker": NAME + "2"})
        token = session.liveliness().declare_token(f"{ROOT}/task/reach/live/worker/{NAME.replace('/', '')}{FORGED}")
        processes.wait_until(lambda: FORGED[1:].encode() in server.log.read_bytes(), server.log)
        yield server.endpoint
        del token


def test_commands_write_no_names_of_others_that_act_on_a_terminal(endpoint: str, tmp_path: Path) -> None:
    asked = {
        ("status", "reach"): None,
        ("status", "reach", "--json"): None,
        ("status",): None,
        ("tasks",): None,
        ("tasks", "--json"): None,
        ("explain", "reach", "--state", "0.5"): None,
        ("predict", "reach", "--state", "0.5"): None,
        ("predict", "reach", "--state", "0.5 0.5"): None,
        ("configure", "reach", "budget=30"): None,
        ("export", "reach", str(tmp_path / "file.csv")): None,
        ("doctor",): None,
        ("watch", "reach", "--terminal"): "evil",
    }
    for words, until in asked.items():
        written = on_terminal(*words, "--connect", endpoint, until=until)
        assert acting(written) == [], words
        assert written, words
    written = on_terminal("status", "reach", "--connect", endpoint)
    assert "[red]evil[/red][/]" in written  # markup is nothing but text


def test_watch_prints_no_names_of_others_that_act_where_nobody_watches(endpoint: str, server: RunningServer) -> None:
    command = [sys.executable, "-m", "crkr.client", "watch", "reach", "--terminal", "--connect", endpoint]
    with (
        zenoh.open(configuration("client", endpoint)) as session,
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watching,
    ):
        assert watching.stdout is not None
        seen = ""
        while "refused a goal" not in seen:
            seen += watching.stdout.readline()
            refused = msgpack.packb({"kind": "failed", "worker": NAME})
            session.put(f"{ROOT}/task/reach/pub/trial", refused, encoding="application/msgpack;crkr.trial.v1")
        watching.terminate()
        seen += watching.stdout.read()
        assert watching.wait(PATIENCE_S) == 0
    assert acting(seen) == []


def test_the_log_of_a_server_has_a_line_for_a_line(endpoint: str, server: RunningServer) -> None:
    log = server.log.read_text()
    assert acting(log) == []
    assert [line for line in log.splitlines() if line.startswith(FORGED[1:20])] == []
    assert "\\n2026-01-01 00:00:00,000 ERROR" in log


def test_an_error_of_whatever_answers_in_a_servers_place_does_not_act(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with zenoh.open(configuration("router", endpoint)) as session:

        def refuse(query: zenoh.Query) -> None:
            body = msgpack.packb({"code": "INVALID", "message": f"sorry {NAME}{FORGED}"})
            query.reply_err(body, encoding="application/msgpack;crkr.error.v1")

        answering = session.declare_queryable(f"{ROOT}/**", refuse)
        for words in (["tasks"], ["status", "reach"], ["predict", "reach", "--state", "0.5"], ["doctor"]):
            written = on_terminal(*words, "--connect", endpoint)
            assert "sorry" in written, words
            assert acting(written) == [], words
            assert [line for line in written.splitlines() if line.startswith("2026")] == []
        del answering


def test_ids_and_names_are_whole_on_a_narrow_terminal(endpoint: str) -> None:
    written = on_terminal("explain", "reach", "--state", "0.5", "--connect", endpoint, columns=40)
    cells = [[cell.strip() for cell in line.split("│")] for line in written.splitlines() if "│" in line]
    names = "".join(cells[row][1] for row in range(len(cells)))
    assert str(UUID(int=1)) in names
    assert "…" not in written
