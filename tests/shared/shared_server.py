"""A real server for several tests; each makes tasks of its own."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

GONE_WITHIN_S = 60.0
SERVER_PYTHON = os.environ.get("CRKR_SERVER_PYTHON", sys.executable)  # where the client's is an earlier one


@contextmanager
def shared_server(data: Path | str, *options: str) -> Iterator[str]:
    """The endpoint of a server that may still be starting; clients wait for it."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    command = [SERVER_PYTHON, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data), *options]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            yield endpoint
        finally:
            process.terminate()
            assert process.wait(GONE_WITHIN_S) == 0
