"""A Zenoh configuration file brings what crkr leaves to it, and cannot undo what crkr needs."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh

from crkr.protocol import Invalid
from crkr.server.session import _config, endpoints

Ask = Callable[..., dict[str, Any]]

LEASE = "transport/link/tx/lease"
CUT_OFF = "transport/link/tx/queue/congestion_control/block/wait_before_close"
LARGEST = "transport/link/rx/max_message_size"

DENY_ADMINISTRATION = {
    "mode": "peer",
    "scouting": {"multicast": {"enabled": True}},
    "access_control": {
        "enabled": True,
        "default_permission": "allow",
        "rules": [
            {
                "id": "no administration",
                "permission": "deny",
                "flows": ["ingress"],
                "messages": ["query"],
                "key_exprs": ["crkr/@v1/task/*/admin/*"],
            }
        ],
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": ["no administration"], "subjects": ["everybody"]}],
    },
}


def test_an_access_list_can_deny_administration_alone(
    tmp_path: Path, free_port: int, connect: Callable[[str], Ask], plain: Callable[[str], Any], reach: dict[str, Any]
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    config = tmp_path / "zenoh.json5"
    config.write_text(json.dumps({**DENY_ADMINISTRATION, "listen": {"endpoints": [endpoint]}}))
    command = [sys.executable, "-m", "crkr.client", "server", "--data", str(tmp_path / "data")]
    with subprocess.Popen([*command, "--zenoh-config", str(config)], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "listening on" in process.stderr.readline()
        ask = connect(endpoint)
        assert ask("rpc/create_task", reach)["created"] is True
        assert ask("task/reach/rpc/status")["seq"] == 1
        silent = plain(endpoint).get(
            "crkr/@v1/task/reach/admin/archive", payload=b"", consolidation=zenoh.ConsolidationMode.NONE, timeout=5.0
        )
        assert list(silent) == []
        assert ask("task/reach/rpc/status")["archived"] is False
        process.terminate()
        assert process.wait(timeout=60) == 0


def test_a_configuration_file_keeps_what_protects_the_server_unless_it_says_otherwise(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        '{transport: {link: {tx: {lease: 700}}}, access_control: {enabled: true, default_permission: "deny"}}'
    )
    alone, merged = _config(None, None), _config(None, file)
    assert json.loads(merged.get_json(LEASE)) == 700
    for name in (CUT_OFF, LARGEST, "transport/unicast/accept_timeout", "transport/unicast/accept_pending"):
        assert merged.get_json(name) == alone.get_json(name) != zenoh.Config().get_json(name)
    assert json.loads(merged.get_json("access_control/enabled")) is True


def test_a_configuration_file_that_names_no_endpoint_leaves_the_server_on_loopback(tmp_path: Path) -> None:
    silent, telling = tmp_path / "silent.json5", tmp_path / "telling.json5"
    silent.write_text("{}")
    telling.write_text('{listen: {endpoints: {router: ["tcp/127.0.0.1:7001"]}}}')
    assert endpoints(None, None) == endpoints(None, silent) == ["tcp/127.0.0.1:7447"]
    assert endpoints(None, telling) == ["tcp/127.0.0.1:7001"]
    assert endpoints("tcp/127.0.0.1:7002", telling) == ["tcp/127.0.0.1:7002"]


def test_files_that_a_configuration_names_are_looked_for_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, authority = tmp_path / "server" / "zenoh.json5", tmp_path / "server" / "ca.pem"
    file.parent.mkdir()
    file.write_text('{transport: {link: {tls: {root_ca_certificate: "ca.pem"}}}}')
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Invalid, match=r"root_ca_certificate '.*/server/ca\.pem'"):
        _config(None, file)
    authority.touch()
    relative = _config(None, Path("server/zenoh.json5"))
    assert json.loads(relative.get_json("transport/link/tls/root_ca_certificate")) == str(authority)
