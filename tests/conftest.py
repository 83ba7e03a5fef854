"""Fixtures that every part's tests may ask for: a free port, a real server, and questions about processes."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from uuid import uuid4

import pytest
import zenoh
from hypothesis import HealthCheck, settings
from postgres import Postgres, running_postgres
from processes import SERVER_PYTHON, Processes, RunningServer

# Property tests are about values, not about time: a busy machine is no failure.
settings.register_profile("values", deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("values")

# A shell that starts the tests in the background has Ctrl-C ignored, and `nohup` a closed terminal. The processes that
# tests start would inherit that, and no signal that a test sends would end them.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Three workers for two idle cores, as tests wait for other processes a third of the time; on busy ones two."""
    cores = os.cpu_count() or 1
    idle = os.getloadavg()[0] < cores
    return min(8, cores * 3 // 2 if idle else cores)


INFO = "crkr/@v1/rpc/info"
READY_WITHIN_S = 60.0
GONE_WITHIN_S = 60.0


def unused_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def client_config(endpoint: str) -> zenoh.Config:
    """Plain Zenoh, none of our client: what any language's binding would be given."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("connect/timeout_ms", "0")
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/gossip/enabled", "false")
    return config


def answers(endpoint: str) -> bool:
    """Whether a server answers `info` at an endpoint."""
    try:
        with zenoh.open(client_config(endpoint)) as session:
            return any(reply.ok is not None for reply in session.get(INFO, timeout=1.0))
    except zenoh.ZError:
        return False


def wait_until_ready(server: RunningServer) -> None:
    """Returns when the server answers; fails when it ends or stays silent."""
    deadline = time.monotonic() + READY_WITHIN_S
    while not answers(server.endpoint):
        try:
            code = server.process.wait(timeout=0.05)
        except subprocess.TimeoutExpired:
            if time.monotonic() > deadline:
                pytest.fail(f"no server at {server.endpoint} within {READY_WITHIN_S} s:\n{server.log.read_text()}")
        else:
            pytest.fail(f"the server ended with status {code}:\n{server.log.read_text()}")


@contextmanager
def running_server(data: Path | str, log: Path, port: int, *options: str) -> Iterator[RunningServer]:
    endpoint = f"tcp/127.0.0.1:{port}"
    command = [SERVER_PYTHON, "-m", "crkr.client", "server", "--listen", endpoint, "--data", str(data), *options]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with log.open("ab") as sink, subprocess.Popen(command, stdout=sink, stderr=sink, env=environment) as process:
        server = RunningServer(endpoint, port, Path(data), log, process)
        try:
            wait_until_ready(server)
            yield server
        finally:
            stop(process)
            sys.stdout.write(log.read_text())  # pytest shows it beside a failure, and only then


def stop(process: subprocess.Popen[bytes]) -> None:
    """Asks a process to end as a service manager would; one that does not is killed and fails the test."""
    process.send_signal(signal.SIGTERM)
    try:
        process.wait(timeout=GONE_WITHIN_S)
    except subprocess.TimeoutExpired:
        process.kill()
        pytest.fail(f"process {process.pid} did not end within {GONE_WITHIN_S} s of SIGTERM")


@pytest.fixture(scope="session")
def processes() -> Processes:
    """Questions about processes."""
    return Processes()


@pytest.fixture
def free_port() -> int:
    """A loopback port that nothing listens on."""
    return unused_port()


@pytest.fixture
def start_server(tmp_path: Path) -> Iterator[Callable[..., RunningServer]]:
    """Starts servers: `start_server(*options, data=DIR, port=PORT)`; all of them are stopped at the end of the test."""
    with ExitStack() as stack:

        def start(
            *options: str, data: Path | str | None = None, port: int | None = None, log: str = "server.log"
        ) -> RunningServer:
            return stack.enter_context(
                running_server(data or tmp_path / "data", tmp_path / log, port or unused_port(), *options)
            )

        yield start


@pytest.fixture(scope="session")
def postgres() -> Iterator[Postgres]:
    """A PostgreSQL for all tests that leave it running; each makes a database of its own."""
    with running_postgres() as cluster:
        yield cluster


@pytest.fixture
def make_database(postgres: Postgres) -> Callable[[], str]:
    """Makes empty databases; gives their URLs."""
    return lambda: postgres.create(f"test-{uuid4()}")


@pytest.fixture(params=["sqlite", "postgres"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """Where a server of the test keeps its log: a data directory, then a database."""
    if request.param == "sqlite":
        return tmp_path / "data"
    make: Callable[[], str] = request.getfixturevalue("make_database")
    return make()


@pytest.fixture
def server(start_server: Callable[..., RunningServer]) -> RunningServer:
    """A server with an empty data directory, ready to be asked."""
    return start_server()


@pytest.fixture
def unused_ports() -> list[int]:
    """Two loopback ports that nothing listens on."""
    return [unused_port(), unused_port()]
