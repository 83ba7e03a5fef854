"""Commands in processes of their own, with a skill of this folder, always ended."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import pytest
from processes import Processes

from crkr.client import Client, Task

HERE = Path(__file__).parent
PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True)
class Command:
    """A `crkr` command that runs."""

    process: subprocess.Popen[str]
    log: Path
    processes: Processes

    def finish(self) -> tuple[int, str, str]:
        """Exit status, standard output and standard error at its end."""
        output, _ = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, output, self.log.read_text()

    def result(self) -> dict[str, Any]:
        """The one JSON object that it prints when all goes well."""
        status, output, log = self.finish()
        assert status == 0, log
        result: dict[str, Any] = json.loads(output)
        return result

    def wait_for_line(self, text: str) -> str:
        """The first line of its standard error that contains `text`."""
        lines = self.processes.wait_until(
            lambda: [line for line in self.log.read_text().splitlines() if text in line], self.log
        )
        return str(lines[0])

    def members(self) -> list[int]:
        """Processes that it started by `multiprocessing`: evaluator and workers, not the resource tracker."""
        return [
            pid for pid in self.processes.children(self.process.pid) if "spawn_main" in self.processes.command_line(pid)
        ]


class StartCommand(Protocol):
    """Starts `crkr WORDS`."""

    def __call__(self, *words: str) -> Command: ...


def environment() -> dict[str, str]:
    """This process's, with the skills of this folder importable and one thread for each process's algebra."""
    return {**os.environ, "PYTHONPATH": str(HERE), "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}


@contextmanager
def commands(folder: Path, processes: Processes) -> Iterator[StartCommand]:
    """Starts commands; whatever still runs at the end is ended."""
    count = iter(range(100))
    with ExitStack() as stack:

        def start(*words: str) -> Command:
            log = folder / f"command-{next(count)}.log"
            errors = stack.enter_context(log.open("wb"))
            process = stack.enter_context(
                subprocess.Popen(
                    [sys.executable, "-m", "crkr.client", *words],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    env=environment(),
                    text=True,
                )
            )
            stack.callback(end, process)
            return Command(process, log, processes)

        yield start


@pytest.fixture
def start_command(tmp_path: Path, processes: Processes) -> Iterator[StartCommand]:
    """Starts commands in the test's folder."""
    with commands(tmp_path, processes) as start:
        yield start


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """What a run with one supervisor left on a server that still answers."""

    endpoint: str
    report: dict[str, Any]
    log: str
    task: Task
    telemetry: list[tuple[str, dict[str, Any]]]


@pytest.fixture(scope="session")
def shared_endpoint(tmp_path_factory: pytest.TempPathFactory, processes: Processes) -> Iterator[str]:
    """A server that tests share, each with a task of its own."""
    folder = tmp_path_factory.mktemp("server")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with commands(folder, processes) as start:
        start("server", "--listen", endpoint, "--data", str(folder / "data")).wait_for_line("listening on")
        yield endpoint


@pytest.fixture(scope="session")
def finished_run(
    shared_endpoint: str, tmp_path_factory: pytest.TempPathFactory, processes: Processes
) -> Iterator[FinishedRun]:
    """Two workers, 120 trials, ten fixed contexts, seed 1."""
    with (
        commands(tmp_path_factory.mktemp("finished"), processes) as start,
        Client(shared_endpoint, timeout_s=30.0) as client,
    ):
        task = client.task("reaching")
        with task.subscribe(("trial", "evaluation")) as subscription:
            options = {"-n": 2, "--trials": 120, "--evaluations": 10, "--seed": 1, "--connect": shared_endpoint}
            words = [str(word) for option in options.items() for word in option]
            command = start("workers", "reaching:make", "--json", *words)
            report = command.result()
            telemetry = []
            while (message := subscription.receive(0.5)) is not None:
                telemetry.append(message)
        yield FinishedRun(shared_endpoint, report, command.log.read_text(), task, telemetry)


def end(process: subprocess.Popen[str]) -> None:
    """Ends a process that a test has left, and its children with it."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()


@pytest.fixture
def skills_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes the skills of this folder importable."""
    monkeypatch.syspath_prepend(HERE)


@pytest.fixture
def client(shared_endpoint: str) -> Iterator[Client]:
    """A client of the shared server."""
    with Client(shared_endpoint, timeout_s=30.0) as client:
        yield client


@pytest.fixture
def task(client: Client, tmp_path: Path) -> Task:
    """A task of the test's own, not made yet."""
    return client.task(re.sub(r"[^a-z0-9]+", "-", tmp_path.name.lower()).strip("-")[-40:].lstrip("-"))
