"""The README's program runs as it is printed."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest
from processes import RunningServer

README = Path(__file__).parents[2] / "README.md"
ENDPOINT = "tcp/127.0.0.1:7447"  # the default, which another server may hold while this runs


def program() -> str:
    """The first block of Python of the first screen."""
    block = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert block is not None
    return block[1]


def test_the_first_program_fits_the_first_screen() -> None:
    lines = [line for line in program().splitlines() if line.strip()]
    assert len(lines) <= 10
    assert README.read_text().index("```python") < 2000


def test_the_first_program_runs_beside_workers_that_learn(
    server: RunningServer, capsys: pytest.CaptureFixture[str]
) -> None:
    workers = [
        "workers",
        "table-tennis",
        "-n",
        "1",
        "--trials",
        "1",
        "--evaluations",
        "0",
        "--connect",
        server.endpoint,
    ]
    subprocess.run([sys.executable, "-m", "crkr.client", *workers], check=True, capture_output=True, timeout=90)
    assert ENDPOINT in program()
    exec(compile(program().replace(ENDPOINT, server.endpoint), str(README), "exec"), {})
    printed = capsys.readouterr().out
    samples = ast.literal_eval(printed[printed.index("{") :])
    assert samples["demonstration"] == 5
    assert samples["trial"] + samples["failed"] == 2, "the worker's, which may not have been executed, and this one"
