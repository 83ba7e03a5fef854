"""One real server for the whole contract; each test makes tasks of its own."""

import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from crkr.client import Client


@pytest.fixture(scope="session")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    data = tmp_path_factory.mktemp("contract")
    command = [sys.executable, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            with Client(endpoint) as client:
                client.wait_until_ready(20.0)
                yield client
        finally:
            process.terminate()
            assert process.wait(60.0) == 0
