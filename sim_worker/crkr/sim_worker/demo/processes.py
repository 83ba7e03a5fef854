"""The demo's processes: started in order, watched, and ended in order within five seconds."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Final, final

from crkr.client import Client
from crkr.client.cli.stop_request import StopRequest
from crkr.protocol import CrkrError, Unavailable
from crkr.sim_worker.demo.process import DemoProcess
from crkr.sim_worker.demo.settings import DemoSettings

__all__ = ["DemoFailed", "DemoProcesses"]

START_S: Final = 30.0
REACH_S: Final = 5.0
TICK_S: Final = 0.1
WORKERS_END_S: Final = 2.6
END_S: Final = 4.6  # for everything, in a hurry; `crkr watch` needs 3.7 s if server, viewer and file are slow
RECORDING_S: Final = 20.0
ECHOED: Final = ("warning: ", "the server answers again", "port ")


class DemoFailed(CrkrError):
    """One of the demo's processes could not start, or ended too early."""


@final
class DemoProcesses:
    """Server, dashboard and workers of one demo.

    Attributes:
        viewer: The viewer's address, once it is known.
        dashboard_lost: Whether `crkr watch` failed or died.
    """

    def __init__(self, settings: DemoSettings, say: Callable[[str], None]) -> None:
        self.viewer: str | None = None
        self.dashboard_lost = False
        self._settings = settings
        self._say = say
        self._server: DemoProcess | None = None
        self._watch: DemoProcess | None = None
        self._workers: DemoProcess | None = None
        self._ending_since: float | None = None

    def start_server(self, stop: StopRequest, client: Client) -> bool:
        """Starts the server and waits until it answers; False if stopped meanwhile.

        Raises:
            DemoFailed: It ended, is silent for too long, or listens and cannot be reached.
        """
        settings = self._settings
        log = settings.database or str(settings.data)
        self._server = self._start("server", ["server", "--listen", settings.endpoint, "--data", log])
        deadline = time.monotonic() + START_S
        while not any(" listening on " in line for line in self._server.new_lines()):
            if self._server.status is not None:
                raise DemoFailed(f"the server did not start: {self._server.last_words()}")
            if time.monotonic() > deadline:
                raise DemoFailed(f"the server said nothing for {START_S:g} s; see {self._server.log}")
            if stop:
                return False
            time.sleep(TICK_S)
        try:
            client.wait_until_ready(REACH_S)
        except Unavailable as error:
            where = settings.endpoint
            raise DemoFailed(f"the server listens at {where} and cannot be reached; is the loopback up?") from error
        return True

    def start_dashboard(self, stop: StopRequest) -> None:
        """Starts `crkr watch` and waits until it can record; if it fails, the demo continues without it."""
        settings = self._settings
        watch = ["watch", settings.task, "--web", "--save", str(settings.recording), "--connect", settings.endpoint]
        self._watch = self._start("watch", watch)
        deadline = time.monotonic() + START_S
        while self.viewer is None and not self.dashboard_lost and not stop and time.monotonic() < deadline:
            time.sleep(TICK_S)
            self._check_dashboard()

    def start_workers(self) -> None:
        """Starts `crkr workers`."""
        settings = self._settings
        command = ["workers", settings.skill, "--task", settings.task, "--connect", settings.endpoint, "--json"]
        numbers = ["-n", str(settings.workers), "--trials", str(settings.trials), "--seed", str(settings.seed)]
        self._workers = self._start("workers", [*command, *numbers])

    def check(self) -> bool:
        """Prints what the processes say; False when the workers are done.

        Raises:
            DemoFailed: The server or the workers ended with an error.
        """
        self._check_dashboard()
        if self._server is None or self._workers is None:
            return True
        self._echo(self._workers)
        if self._server.status is not None:
            ended = f"the server ended with status {self._server.status}"
            raise DemoFailed(f"{ended}: {self._server.last_words()}; what was acknowledged is stored")
        if self._workers.status not in (None, 0):
            raise DemoFailed(f"the workers ended: {self._workers.last_words()}")
        return self._workers.status is None

    def workers_report(self) -> dict[str, Any]:
        """The report of `crkr workers`; empty before its end."""
        try:
            report = json.loads(self._workers.output()) if self._workers else {}
        except json.JSONDecodeError:
            return {}
        return report if isinstance(report, dict) else {}

    def stop_workers(self, *, hurry: bool = False) -> None:
        """Ends the workers if they still run; in a hurry, the dashboard is interrupted at the same time."""
        if hurry:
            self._ending_since = self._ending_since or time.monotonic()
            if self._watch is not None:
                self._watch.interrupt()
        if self._workers is not None:
            self._workers.interrupt()
            self._workers.end(WORKERS_END_S)
            self._echo(self._workers)

    def stop_rest(self, *, hurry: bool) -> None:
        """Ends dashboard and server; without hurry, there is time to write a long recording."""
        rest = [process for process in (self._watch, self._server) if process is not None]
        for process in rest:
            process.interrupt()
        now = time.monotonic()
        deadline = (self._ending_since or now) + END_S if hurry else now + RECORDING_S
        for process in rest:
            if not process.end(deadline - time.monotonic()):
                self._say(f"warning: {process.name} did not end in time and was killed")
        self._watch = self._server = None

    def _check_dashboard(self) -> None:
        if self._watch is None or self.dashboard_lost:
            return
        for line in self._watch.new_lines():
            if line.startswith("viewer: "):
                self.viewer = line.removeprefix("viewer: ")
                self._say(line)
        if self._watch.status is not None:
            self.dashboard_lost = True
            self._say(f"warning: the dashboard is gone ({self._watch.last_words()}); learning continues without it")

    def _echo(self, process: DemoProcess) -> None:
        for line in process.new_lines():
            if line.startswith(ECHOED):
                self._say(line)

    def _start(self, name: str, arguments: list[str]) -> DemoProcess:
        return DemoProcess(name, arguments, self._settings.logs)
