"""Where a client connects, and what it forces Zenoh to."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from processes import SERVER_PYTHON

from crkr.client.network.config import DEFAULT_ENDPOINT, Connection
from crkr.protocol import Invalid


@pytest.fixture(autouse=True)
def no_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CRKR_CONNECT", raising=False)


@pytest.fixture
def zenoh_file(tmp_path: Path) -> Path:
    path = tmp_path / "zenoh.json5"
    path.write_text(
        '{mode: "peer", connect: {endpoints: ["tcp/127.0.0.1:7001"]}, transport: {link: {tx: {lease: 700}}}}'
    )
    return path


def test_the_endpoint_is_what_is_nearest_at_hand(monkeypatch: pytest.MonkeyPatch, zenoh_file: Path) -> None:
    assert Connection.choose(None, None).endpoint == DEFAULT_ENDPOINT
    assert Connection.choose(None, zenoh_file).endpoint == "tcp/127.0.0.1:7001"
    monkeypatch.setenv("CRKR_CONNECT", "tcp/127.0.0.1:7002")
    assert Connection.choose(None, zenoh_file).endpoint == "tcp/127.0.0.1:7002"
    assert Connection.choose("tls/learner:7003", zenoh_file).endpoint == "tls/learner:7003"


def test_nothing_is_discovered_and_nothing_shared(zenoh_file: Path) -> None:
    config = Connection.choose(None, zenoh_file).zenoh(0.5)
    settings = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "connect/timeout_ms": 500,
    }
    assert {key: json.loads(config.get_json(key)) for key in settings} == settings


def test_a_silent_partition_is_noticed_in_two_seconds_unless_the_file_knows_better(zenoh_file: Path) -> None:
    leases = [
        json.loads(Connection.choose(None, path).zenoh(1.0).get_json("transport/link/tx/lease"))
        for path in (None, zenoh_file)
    ]
    assert leases == [2000, 700]


def test_several_endpoints_are_each_checked_and_given_to_zenoh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CRKR_CONNECT", "tcp/a:7447, tcp/b:7447")
    connection = Connection.choose(None, None)
    assert json.loads(connection.zenoh(1.0).get_json("connect/endpoints")) == ["tcp/a:7447", "tcp/b:7447"]
    assert json.loads(connection.zenoh(1.0, 1).get_json("connect/endpoints")) == ["tcp/b:7447", "tcp/a:7447"]
    with pytest.raises(Invalid, match="'b:7447': it is not of the form"):
        Connection.choose("tcp/a:7447,b:7447", None)


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "localhost", "tcp/", "tcp/a b"])
def test_what_is_no_endpoint_is_refused_with_an_example(endpoint: str) -> None:
    with pytest.raises(Invalid, match="tcp/127"):
        Connection.choose(endpoint, None)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.json5"
    broken.write_text("{mode: ")
    for path in (broken, tmp_path / "absent.json5"):
        with pytest.raises(Invalid, match=path.name):
            Connection.choose(None, path)


def test_certificates_are_looked_for_beside_the_file_that_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, key = tmp_path / "robot" / "client.json5", tmp_path / "robot" / "client.key"
    file.parent.mkdir()
    file.write_text('{transport: {link: {tls: {connect_private_key: "client.key"}}}}')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Invalid, match=r"connect_private_key '.*/robot/client\.key'"):
        Connection.choose("tls/learner:7447", Path("robot/client.json5"))
    key.touch()
    config = Connection.choose("tls/learner:7447", Path("robot/client.json5")).zenoh(1.0)
    assert json.loads(config.get_json("transport/link/tls/connect_private_key")) == str(key)


@pytest.mark.parametrize("command", [["status"], ["server", "--listen", "tcp/127.0.0.1:0"]], ids=["client", "server"])
def test_a_variable_that_zenoh_cannot_read_is_named(command: list[str], tmp_path: Path) -> None:
    words = [SERVER_PYTHON if command[0] == "server" else sys.executable, "-m", "crkr.client", *command]
    environment = {**os.environ, "ZENOH_RUNTIME": "garbage"}
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 1
    assert "error: Zenoh did not start; look at ZENOH_RUNTIME, which is 'garbage'" in done.stderr
    assert "Traceback" not in done.stderr
