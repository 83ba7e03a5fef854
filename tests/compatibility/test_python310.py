"""The client on Python 3.10 with numpy 1.26, as ROS 2 Humble and Jazzy have them; `scripts/python310` makes it."""

import ast
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import RunningServer

REPOSITORY = Path(__file__).parents[2]
PYTHON310 = REPOSITORY / "build" / "python310" / "bin" / "python"
CONVERSATION = Path(__file__).with_name("conversation.py")
LATER = {  # what those modules do not have on Python 3.10
    "asyncio": {"Runner", "TaskGroup", "timeout", "timeout_at"},
    "contextlib": {"chdir"},
    "datetime": {"UTC"},
    "enum": {"StrEnum"},
    "typing": {"LiteralString", "Never", "NotRequired", "Required", "Self", "Unpack", "assert_never", "reveal_type"},
}
needs_it = pytest.mark.skipif(not PYTHON310.exists(), reason="no Python 3.10 with the client: run scripts/python310")


def later_names(source: str) -> list[str]:
    """Names of Python 3.11 that a module imports, outside a check of the version."""
    tree = ast.parse(source, feature_version=(3, 10))
    guarded = {id(inner) for node in ast.walk(tree) if isinstance(node, ast.If) for inner in ast.walk(node)}
    found = []
    for node in ast.walk(tree):
        if id(node) in guarded:
            continue
        if isinstance(node, ast.ImportFrom) and node.module in LATER:
            found += [alias.name for alias in node.names if alias.name in LATER[node.module]]
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name == "tomllib"]
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in LATER:
            found += [node.attr] if node.attr in LATER[node.value.id] else []
        elif isinstance(node, ast.TryStar):
            found.append("except*")
    return found


def test_the_clients_parts_use_nothing_later_than_python_310() -> None:
    modules = [path for part in ("protocol", "learner", "client") for path in (REPOSITORY / part).rglob("*.py")]
    assert len(modules) > 80
    found = {path.name: names for path in modules if (names := later_names(path.read_text(encoding="utf-8")))}
    assert found == {}
    assert later_names("import tomllib\nfrom typing import Self\nimport asyncio\nasyncio.timeout(1)\n") == [
        "tomllib",
        "Self",
        "timeout",
    ]


def tell(python: str, part: str, endpoint: str, file: Path) -> Any:
    command = [python, str(CONVERSATION), part, endpoint, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@needs_it
def test_it_is_told_the_same_as_the_client_of_this_python(
    start_server: Callable[..., RunningServer], tmp_path: Path
) -> None:
    told = []
    for number, python in enumerate((sys.executable, str(PYTHON310))):
        server = start_server(data=tmp_path / f"data{number}")
        told.append(tell(python, "converse", server.endpoint, tmp_path / f"outbox{number}"))
    assert told[0] == told[1]


@needs_it
def test_its_commands_work_and_those_of_other_parts_say_what_they_need(server: RunningServer) -> None:
    def crkr(*words: str) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "CRKR_CONNECT": server.endpoint}
        command = [str(PYTHON310), "-m", "crkr.client", *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment)

    assert crkr("create", str(REPOSITORY / "examples" / "throw.toml")).stdout == "created throw (R^2 -> R^2)\n"
    shown = ["--state", "0.3 1.2", "--goal", "3.4 0.25", "--cost", "0.1", "--hit", "--kind", "demonstration", "--wait"]
    assert crkr("report", "throw", *shown).stdout.startswith("stored")
    assert "3.4" in crkr("predict", "throw", "--state", "0.3 1.2").stdout
    assert crkr("status", "throw", "--json").returncode == 0
    for command in ("server", "workers"):
        done = crkr(command, "throw")
        assert (done.returncode, done.stderr) == (
            1,
            f"error: crkr {command} needs Python 3.11 or newer; this is 3.10\n",
        )
