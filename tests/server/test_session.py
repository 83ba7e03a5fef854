"""A Zenoh configuration file brings what crkr leaves to it, and cannot undo what crkr needs."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zenoh

Ask = Callable[..., dict[str, Any]]

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
        assert process.wait(timeout=5) == 0
