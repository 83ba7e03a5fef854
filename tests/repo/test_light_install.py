"""The base install is a client for robots: importing it, or asking for help, must not need the extras."""

import json
import subprocess
import sys

import pytest

HEAVY = ["PIL", "av", "clarabel", "coal", "joblib", "matplotlib", "mujoco", "pinocchio"]
HEAVY += ["prometheus_client", "pyarrow", "rerun", "scipy", "sklearn", "starlette", "uvicorn"]

# The extras cannot be imported at all.
FINDER = """
import importlib.abc, json, sys

class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if BLOCK and name.split(".")[0] in HEAVY:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""
# Runs a statement there, and prints which modules came in.
HARNESS = (
    FINDER
    + """
try:
    STATEMENT
except SystemExit as exit:
    assert not exit.code, exit.code
print(json.dumps(sorted({name.split(".")[0] for name in sys.modules})), file=sys.stderr)
"""
)
START = "from crkr.client.cli.main import main; main()"
HELP = f"sys.argv = ['crkr', '--help']; {START}"


def _run(statement: str, *, block: bool) -> tuple[str, set[str]]:
    """Standard output of a fresh interpreter, and the top-level modules it had imported at the end."""
    code = f"HEAVY, BLOCK = {HEAVY!r}, {block!r}\n" + HARNESS.replace("STATEMENT", statement)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout, set(json.loads(done.stderr.splitlines()[-1]))


def test_importing_the_client_imports_no_heavy_library() -> None:
    _, modules = _run("from crkr.client import Client", block=False)
    assert "zenoh" in modules
    assert modules.isdisjoint(HEAVY)


def test_asking_for_help_imports_no_heavy_library() -> None:
    text, modules = _run(HELP, block=False)
    assert "server" in text
    assert modules.isdisjoint(HEAVY)


def test_the_client_and_the_command_work_without_the_extras() -> None:
    _run("from crkr.client import *; from crkr.protocol import *", block=True)
    text, _ = _run(HELP, block=True)
    assert "server" in text


@pytest.mark.parametrize(
    ("command", "arguments", "extra"),
    [
        ("bench learn", "", "experiments"),
        ("bench predict", "", "experiments"),
        ("bench report", "", "experiments"),
        ("bench sim", "", "experiments"),
        ("experiment learning", "", "experiments"),
        ("export", "throw throw.parquet", "export"),
        ("page", "--serve 8080", "web"),
        ("plot coverage", "throw", "sim"),
        ("plot learning", "throw", "sim"),
        ("plot policy", "throw --vary x", "sim"),
        ("server", "--metrics 9464", "server"),
    ],
)
def test_a_command_without_its_extra_says_so_in_one_line(command: str, arguments: str, extra: str) -> None:
    words = ["crkr", *command.split(), *arguments.split()]
    code = f"HEAVY, BLOCK = {HEAVY!r}, True\n" + FINDER + f"sys.argv = {words!r}\n{START}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert done.stderr == f"error: crkr {command} needs the extra '{extra}': pip install 'crkr[{extra}]'\n"


def test_a_heavy_import_is_seen() -> None:
    _, modules = _run("import scipy.linalg", block=False)
    assert not modules.isdisjoint(HEAVY)
