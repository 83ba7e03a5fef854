"""The examples run as they stand, against a real server."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from processes import RunningServer

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name: str, endpoint: str) -> str:
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / name), endpoint], capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    return result.stdout


def test_the_quickstart_learns_to_hit_from_three_demonstrations(server: RunningServer) -> None:
    before, after = (int(share) for share in re.findall(r"(\d+)%", run("quickstart.py", server.endpoint)))
    assert before <= 70
    assert after >= 95


def test_the_quickstart_says_in_one_line_that_there_is_no_server(free_port: int) -> None:
    command = [sys.executable, str(EXAMPLES / "quickstart.py"), f"tcp/127.0.0.1:{free_port}"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 1
    assert result.stdout == ""
    assert re.fullmatch(rf"error: no server at tcp/127.0.0.1:{free_port} within .* s; start .*\n", result.stderr)


def test_the_specification_file_makes_the_task_that_the_help_asks(server: RunningServer) -> None:
    def crkr(*words: str) -> str:
        command = [sys.executable, "-m", "crkr.client", *words, "--connect", server.endpoint]
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert result.returncode == 0, result.stderr
        return result.stdout

    assert crkr("create", str(EXAMPLES / "throw.toml")) == "created throw (R^2 -> R^2)\n"
    trial = ["--state", "0.3 1.2", "--goal", "3.4 0.25", "--cost", "0.12", "--success", "--kind", "demonstration"]
    assert crkr("report", "throw", *trial, "--wait").startswith("stored")
    assert "3.4" in crkr("predict", "throw", "--state", "0.3 1.2")


def test_a_reader_without_our_package_holds_a_full_conversation(server: RunningServer) -> None:
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


def test_a_skill_of_ones_own_learns_from_misses_too(server: RunningServer) -> None:
    def crkr(*words: str) -> dict[str, Any]:
        command = [sys.executable, "-m", "crkr.client", *words, "--json", "--connect", server.endpoint]
        result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, cwd=EXAMPLES.parent)
        assert result.returncode == 0, result.stderr
        answer: dict[str, Any] = json.loads(result.stdout)
        return answer

    assert len([line for line in (EXAMPLES / "reach.py").read_text().splitlines() if line.strip()]) <= 40
    crkr("workers", "examples/reach.py:make", "-n", "2", "--trials", "400", "--seed", "1")
    judged = crkr("evaluate", "reach", "--contexts", "500", "--seed", "7")
    assert judged["success"] >= 0.75, "with the plain exploration, which learns from successes only, it is below 0.3"


def test_the_example_of_a_stroke_passes_its_goal_and_says_why_another_is_refused() -> None:
    command = [sys.executable, str(EXAMPLES / "stroke.py")]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    assert re.search(r"^ +0\.50 +0\.500 +0\.900 +1\.200 +-0\.800$", result.stdout, re.MULTILINE)
    assert "a hit after 0.2 s is refused (out_of_reach): joint 0: goal position cannot be reached" in result.stdout
