"""The examples run as they stand, against a real server."""

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, endpoint: str) -> str:
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / name), endpoint], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def test_the_quickstart_learns_to_hit_from_three_demonstrations(server: Any) -> None:
    before, after = (int(share) for share in re.findall(r"(\d+)%", run("quickstart.py", server.endpoint)))
    assert before <= 70
    assert after >= 95


def test_a_reader_without_our_package_holds_a_full_conversation(server: Any) -> None:
    imported = {
        name.split(".")[0]
        for node in ast.walk(ast.parse((EXAMPLES / "plain_client.py").read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""])
    }
    assert imported - set(sys.stdlib_module_names) == {"zenoh", "msgpack"}

    said = dict(line.split(":", 1) for line in run("plain_client.py", server.endpoint).splitlines() if ":" in line)
    assert said["created"] == " True"
    assert said["created again"] == " False"
    assert "'accepted': 4, 'duplicates': 0, 'seqs': [2, 3, 4, 5], 'model_version': 5" in said["receipt"]
    assert "'accepted': 0, 'duplicates': 4, 'seqs': [2, 3, 4, 5], 'model_version': 5" in said["the same again"]
    assert said["asked again"] == " True"
    assert said["log"].count("demonstration") == 4
    codes = {what: answer.split()[0] for what, answer in said.items() if answer.split() and answer.split()[0].isupper()}
    assert (
        codes.items()
        >= {
            "before any sample": "NO_SAMPLES",
            "a goal out of bounds": "INVALID",
            "half a message": "INVALID",
            "no such task": "UNKNOWN_TASK",
            "another specification": "CONFLICT",
            "another trial under a known id": "CONFLICT",
            "no such verb": "UNSUPPORTED",
            "another version": "UNSUPPORTED",
            "far from all samples": "NOVEL_STATE",
            "too much at once": "BUSY",
        }.items()
    )
