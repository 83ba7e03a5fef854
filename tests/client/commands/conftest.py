"""Commands in process, against the server that several tests share."""

from collections.abc import Callable

import pytest
from typer.testing import CliRunner, Result

from crkr.client import Client
from crkr.client.cli.subcommands import build


@pytest.fixture(scope="module")
def run(shared_endpoint: str) -> Callable[..., Result]:
    """`run("trials", NAME, typed="y", status=0)`: the result of a command with the exit status that is expected."""
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)

    def run(command: str, *arguments: str, typed: str | None = None, status: int = 0) -> Result:
        words = [command, *arguments, "--connect", shared_endpoint]
        result = CliRunner().invoke(build(words), words, input=typed)
        assert result.exit_code == status, f"{result.stdout}\n{result.stderr}\n{result.exception!r}"
        return result

    return run
