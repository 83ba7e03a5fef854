"""This version beside the one before: real processes of both, in both directions, and what the earlier one wrote.

The wheel in this folder holds protocol, learner, client and server of version 0.1, before tasks had a verb of their own
for their specifications. It runs with the libraries of today.
"""

import json
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from crkr.client import Client
from crkr.client.network.config import Connection
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.protocol import Unavailable, Unsupported, task_key

FOLDER = Path(__file__).parent
DEADLINE_S = 100.0
Start = Callable[..., Any]


# Parts of a specification that came, or have other defaults, since the version before.
NEW = re.compile(r"/(exploration|start|aim|skill)(/|$)")


def is_new(path: str, value: object) -> bool:
    """Whether the version before had no such part; a specification's cost is a word, a trial's is a number."""
    return bool(NEW.search(path)) or (path.endswith("/cost") and isinstance(value, str))


@pytest.fixture(scope="session")
def earlier(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the earlier version can be imported from."""
    [wheel] = FOLDER.glob("*.whl")
    target = tmp_path_factory.mktemp("earlier")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    return target


@pytest.fixture
def serve(start_server: Start, earlier: Path, monkeypatch: pytest.MonkeyPatch) -> Start:
    """Starts a server of the version that is named: "earlier" or "now"."""

    def start(version: str, **options: Any) -> Any:
        with monkeypatch.context() as environment:
            if version == "earlier":
                environment.setenv("PYTHONPATH", str(earlier))
            return start_server(**options)

    return start


@pytest.fixture
def told(earlier: Path) -> Callable[..., Any]:
    """What a client of the version that is named is told in a part of the conversation."""

    def tell(version: str, part: str, endpoint: str, file: Path) -> Any:
        path = {"PYTHONPATH": str(earlier)} if version == "earlier" else {}
        command = [sys.executable, str(FOLDER / "conversation.py"), part, endpoint, str(file)]
        done = subprocess.run(
            command, env={**os.environ, **path}, capture_output=True, text=True, timeout=DEADLINE_S, check=False
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return tell


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every number, text and nothing inside a value, by where it stands."""
    if isinstance(value, dict | list):
        for key, entry in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(entry, f"{path}/{key}")
    else:
        yield path, value


def assert_alike(one: Any, other: Any) -> None:
    """Equal in what both versions know, numbers to 1e-8: the two may come from other ways to compute the same."""
    mine, theirs = ({path: value for path, value in leaves(each) if not is_new(path, value)} for each in (one, other))
    assert mine.keys() == theirs.keys()
    for path, value in mine.items():
        same = pytest.approx(value, rel=1e-8, abs=1e-8) if isinstance(value, float) else value
        assert theirs[path] == same, path


def test_the_earlier_client_is_another_program(earlier: Path) -> None:
    command = [sys.executable, "-c", "from crkr.protocol import TASK_VERBS; print(*TASK_VERBS)"]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONPATH": str(earlier)}, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == ["predict", "report", "status", "model", "samples", "explain"]


def test_the_earlier_server_is_another_program(serve: Start) -> None:
    connection = Connection.choose(serve("earlier").endpoint, None)
    with ZenohTransport(connection) as transport, pytest.raises(Unsupported, match="'spec' is not offered"):
        Rpc(transport, 5.0).call(task_key("toss", "spec"), {})


@pytest.mark.parametrize(("client", "server"), [("earlier", "now"), ("now", "earlier")])
def test_two_versions_understand_each_other_as_each_understands_itself(
    client: str, server: str, serve: Start, told: Callable[..., Any], tmp_path: Path
) -> None:
    found = {
        version: told(version, "converse", serve(server, data=tmp_path / version).endpoint, tmp_path / f"{version}.box")
        for version in (client, server)
    }
    assert_alike(found[client], found[server])


@pytest.mark.parametrize(("client", "server"), [("earlier", "now"), ("now", "earlier")])
def test_the_commands_of_one_version_work_with_the_other(
    client: str, server: str, serve: Start, earlier: Path, told: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint = serve(server).endpoint
    told("now", "converse", endpoint, tmp_path / "box")
    path = {"PYTHONPATH": str(earlier)} if client == "earlier" else {}
    for words in (["doctor"], ["tasks"], ["status"], ["status", "toss"], ["export", "toss", str(tmp_path / "t.npz")]):
        command = [sys.executable, "-m", "crkr.client", *words, "--connect", endpoint, "--json"]
        done = subprocess.run(
            command, env={**os.environ, **path}, capture_output=True, text=True, timeout=DEADLINE_S, check=False
        )
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        assert "toss" in done.stdout


def test_what_the_earlier_server_lacks_is_said_in_one_line(
    serve: Start, told: Callable[..., Any], tmp_path: Path
) -> None:
    endpoint = serve("earlier").endpoint
    told("now", "converse", endpoint, tmp_path / "box")
    with Client(endpoint, timeout_s=DEADLINE_S) as client:
        task = client.task("toss")
        first = next(task.iter_samples()).trial.id
        with pytest.raises(Unsupported, match="iter_samples"):
            task.trials(last=2)
        with pytest.raises(Unsupported, match="amend"):
            task.amend(first, success=False)
        assert len(task.trials(worst=2)) == 2


def test_a_log_and_an_outbox_of_the_earlier_version_are_read(
    serve: Start, told: Callable[..., Any], tmp_path: Path, free_port: int
) -> None:
    data, box = tmp_path / "data", tmp_path / "box"
    server = serve("earlier", data=data, port=free_port)
    told("earlier", "leave", server.endpoint, box)
    before = told("earlier", "find", server.endpoint, box)
    server.process.terminate()
    server.process.wait()
    server = serve("now", data=data, port=free_port)
    after = told("now", "find", server.endpoint, box)
    for part in (before, after):  # only the process knows the workers of a task
        part[0][1][1] = part[2][1][1] = None
    assert_alike(after, before)
    assert told("now", "deliver", server.endpoint, box) == [6, [0, 0], True]


def test_access_control_that_was_set_up_for_the_earlier_version_leaves_tasks_to_be_found(
    start_server: Start, told: Callable[..., Any], tmp_path: Path
) -> None:
    rules = tmp_path / "rules.json5"
    rules.write_text(
        """{
          access_control: {
            enabled: true,
            default_permission: "allow",
            rules: [{
              id: "new", permission: "deny", flows: ["ingress"], messages: ["query"],
              key_exprs: ["crkr/@v1/task/*/rpc/spec"],
            }],
            subjects: [{id: "all"}],
            policies: [{rules: ["new"], subjects: ["all"]}],
          },
        }"""
    )
    endpoint = start_server("--zenoh-config", str(rules)).endpoint
    with ZenohTransport(Connection.choose(endpoint, None)) as transport, pytest.raises(Unavailable):
        Rpc(transport, 0.3).call(task_key("toss", "spec"), {})
    found = told("now", "converse", endpoint, tmp_path / "box")
    free = start_server(data=tmp_path / "free").endpoint
    assert_alike(found, told("now", "converse", free, tmp_path / "free.box"))
