"""Run compose.yaml for real: two workers, each in a container, learn through the server in its own.

Not collected by pytest: it needs a container engine. `make compose-test` runs it. It builds the images, starts all
under a project name of its own (so that nobody's data is touched), reads the task's log over plain Zenoh through the
published port, restarts the server to see that its volume keeps the log, and removes what it started. Then two servers
on one PostgreSQL take turns: one is killed, then the other stopped, and the database restarted.
"""

import argparse
import os
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgpack
import zenoh

REPOSITORY = Path(__file__).parents[2]
PROJECT = f"crkr-test-{os.getpid()}"
TASK = "crkr/@v1/task/table-tennis"
STANDBY = ("--profile", "standby")
AXIS = {"name": "x", "low": -1.0, "high": 1.0}
REACH = {"name": "reach", "state": [AXIS], "goal": [AXIS]}
WORKERS = 2
TRIALS = 900  # that the workers do together before they leave; the first of them explore boldly and mostly miss
EACH = 20  # successful trials that every one of them must have contributed
BUILT_WITHIN_S, READY_WITHIN_S, LEARNED_WITHIN_S, STEP_WITHIN_S = 1800.0, 90.0, 300.0, 120.0

T = TypeVar("T")


class Failed(Exception):
    """What did not happen, in one line."""


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port


def engine() -> list[str]:
    """The compose command of this machine, or what to install."""
    docker = shutil.which("docker")
    if docker and subprocess.run([docker, "info"], capture_output=True, timeout=30, check=False).returncode == 0:
        return [docker, "compose"]
    podman = shutil.which("podman-compose")
    if podman:
        return [podman]
    raise Failed(
        "no container engine answers. Start Docker, or install podman and podman-compose, or name another: "
        'make compose-test COMPOSE="my-compose"'
    )


class Compose:
    """`compose.yaml` under a project name and ports of its own."""

    def __init__(self, command: list[str]) -> None:
        self.port, self.web_port = free_port(), free_port()
        self.members = {"first": free_port(), "second": free_port()}
        self._command = [*command, "-p", PROJECT]
        self._environment = {
            **os.environ,
            "CRKR_PORT": str(self.port),
            "CRKR_WEB_PORT": str(self.web_port),
            "CRKR_STREAM_PORT": str(free_port()),
            "CRKR_FIRST_PORT": str(self.members["first"]),
            "CRKR_SECOND_PORT": str(self.members["second"]),
            "CRKR_TRIALS": str(TRIALS),
            "NO_COLOR": "1",
        }

    def run(self, *arguments: str, timeout_s: float = STEP_WITHIN_S) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*self._command, *arguments],
            cwd=REPOSITORY,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    def must(self, *arguments: str, timeout_s: float = STEP_WITHIN_S) -> str:
        done = self.run(*arguments, timeout_s=timeout_s)
        if done.returncode != 0:
            raise Failed(f"compose {' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
        return done.stdout


def until(what: str, within_s: float, attempt: Callable[[], T | None]) -> T:
    """Repeats an attempt, a second apart, until it returns something; fails at the deadline."""
    deadline = time.monotonic() + within_s
    pause = threading.Event()
    while (result := attempt()) is None:
        if time.monotonic() > deadline:
            raise Failed(f"{what}: not within {within_s:.0f} s")
        pause.wait(1.0)
    return result


def configuration(port: int) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": '"client"',
        "connect/endpoints": f'["tcp/127.0.0.1:{port}"]',
        "connect/timeout_ms": "0",
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    return config


def ask(port: int, verb: str, request: dict[str, Any], prefix: str = TASK) -> dict[str, Any] | None:
    """One query in plain Zenoh and msgpack; None where nobody answers or the answer is an error."""
    try:
        with zenoh.open(configuration(port)) as session:
            for reply in session.get(f"{prefix}/rpc/{verb}", payload=msgpack.packb(request), timeout=5.0):
                if reply.ok is not None:
                    answer: dict[str, Any] = msgpack.unpackb(reply.ok.payload.to_bytes())
                    return answer
    except zenoh.ZError:
        return None
    return None


def at_work(port: int) -> int | None:
    """How many workers hold a liveliness token of the task; None where the server does not answer."""
    try:
        with zenoh.open(configuration(port)) as session:
            return len(list(session.liveliness().get(f"{TASK}/live/worker/*", timeout=5.0)))
    except zenoh.ZError:
        return None


def trials_by_worker(port: int) -> tuple[Counter[str], Counter[str]] | None:
    """Training trials in the log by worker: all of them, and those that succeeded."""
    done: Counter[str] = Counter()
    learned: Counter[str] = Counter()
    after: int | None = 0
    while after is not None:
        page = ask(port, "samples", {"after": after, "limit": 1000})
        if page is None:
            return None
        done.update(str(s["worker"]) for s in page["samples"] if s["kind"] in {"trial", "failed"})
        learned.update(str(s["worker"]) for s in page["samples"] if s["kind"] == "trial" and s["success"])
        after = page["next"]
    return done, learned


def check(compose: Compose) -> None:
    say("building the images (the first time this takes minutes)")
    compose.must("build", timeout_s=BUILT_WITHIN_S)
    compose.must("up", "-d", "--scale", f"worker={WORKERS}")
    until("the server's health check", READY_WITHIN_S, lambda: healthy(compose))
    say(f"the server is healthy; {WORKERS} workers start")
    learned = until(f"{TRIALS} trials in the log and every worker gone", LEARNED_WITHIN_S, lambda: finished(compose))
    say("successful trials by worker: " + ", ".join(f"{name} {count}" for name, count in sorted(learned.items())))
    if sum(count >= EACH for count in learned.values()) < WORKERS:
        raise Failed(f"fewer than {WORKERS} workers have {EACH} successful trials")
    until("the viewer's page", READY_WITHIN_S, lambda: page(compose))
    compare_restart(compose)


def healthy(compose: Compose) -> bool | None:
    done = compose.run("exec", "-T", "server", "crkr", "status", "--check")
    return True if done.returncode == 0 else None


def finished(compose: Compose) -> Counter[str] | None:
    """Successful trials by worker, once all trials are in the log and the workers have left."""
    counts = trials_by_worker(compose.port)
    if counts is None or counts[0].total() < TRIALS or at_work(compose.port) != 0:
        return None
    return counts[1]


def page(compose: Compose) -> bool | None:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{compose.web_port}/", timeout=5) as answer:
            return True if answer.status == 200 else None
    except (urllib.error.URLError, ConnectionError):
        return None


def compare_restart(compose: Compose) -> None:
    """The model must be the same after a restart: its version is what the log says, and the log is in the volume."""
    before = until("the status before the restart", READY_WITHIN_S, lambda: ask(compose.port, "status", {}))
    compose.must("restart", "server")
    after = until("the status after the restart", READY_WITHIN_S, lambda: ask(compose.port, "status", {}))
    for field in ("samples", "eligible", "active", "model_version"):
        if before[field] != after[field]:
            raise Failed(f"{field} was {before[field]} before the restart and is {after[field]} after it")
    say(f"the server restarted with the same {after['eligible']} eligible samples, {after['active']} of them active")


def check_standby(compose: Compose) -> None:
    """Each of two servers takes over from the other, and keeps all that it acknowledged."""
    compose.must(*STANDBY, "build", "first", timeout_s=BUILT_WITHIN_S)
    compose.must(*STANDBY, "up", "-d", "database", "first", "second")
    owner = until("a server that owns the log", READY_WITHIN_S, lambda: serving(compose, tuple(compose.members)))
    until("the task", READY_WITHIN_S, lambda: ask(compose.members[owner], "create_task", REACH, "crkr/@v1"))
    stored = 1
    for number, how in enumerate(("kill", "stop")):
        other = "second" if owner == "first" else "first"
        until(f"{other} to stand by", READY_WITHIN_S, partial(stands_by, compose, other))
        stored = report(compose, owner, 100 * number, stored)
        compose.must(*STANDBY, how, owner)
        began = time.monotonic()
        until(f"{other} in place of {owner}", READY_WITHIN_S, partial(serving, compose, (other,)))
        say(f"{how} {owner}: {other} answers {time.monotonic() - began:.1f} s after that was done")
        compose.must(*STANDBY, "up", "-d", owner)
        owner = other
        stored = report(compose, owner, 100 * number + 50, stored)
    compose.must(*STANDBY, "restart", "database")
    stored = report(compose, owner, 200, stored)
    say(f"the database restarted; {owner} holds all {stored} entries")


def serving(compose: Compose, names: tuple[str, ...]) -> str | None:
    """Which of these servers answers; None if none does."""
    return next((name for name in names if ask(compose.members[name], "info", {}, "crkr/@v1") is not None), None)


def stands_by(compose: Compose, name: str) -> bool | None:
    done = compose.run(*STANDBY, "logs", name)
    said = done.stdout + done.stderr
    return True if said.rfind("standing by") > said.rfind("listening on") else None


def report(compose: Compose, name: str, first: int, stored: int) -> int:
    """Store ten trials, repeated under their ids until that is acknowledged; returns the log's new last position."""
    trials = [
        {"id": number.to_bytes(16, "big"), "state": [0.1], "goal": [0.2], "cost": 0.5, "success": True, "kind": "trial"}
        for number in range(first, first + 10)
    ]
    request, reach = {"trials": trials, "wait": True}, TASK.replace("table-tennis", "reach")
    receipt = until("reports", READY_WITHIN_S, lambda: ask(compose.members[name], "report", request, reach))
    if receipt["seqs"] != list(range(stored + 1, stored + 11)):
        raise Failed(f"{name} stored ten trials at {receipt['seqs']}, and the log ended at {stored}")
    return stored + 10


@contextmanager
def removed_at_the_end(compose: Compose) -> Iterator[None]:
    try:
        yield
    except Failed:
        for service in ("server", "worker", "watch", "database", *compose.members):
            say(f"--- {service}\n" + compose.run(*STANDBY, "logs", "--tail", "40", service).stdout)
        raise
    finally:
        compose.run(*STANDBY, "down", "--remove-orphans")  # podman-compose forgets scaled containers without it,
        compose.must(*STANDBY, "down", "-v", "--remove-orphans")  # and frees the volume only when all of them are gone


def main() -> int:
    parser = argparse.ArgumentParser(description="Run compose.yaml for real and see two workers learn.")
    parser.add_argument("--compose", type=shlex.split, help="compose command, for example 'docker compose'")
    command = parser.parse_args().compose
    started = time.monotonic()
    try:
        compose = Compose(command or engine())
        with removed_at_the_end(compose):
            check(compose)
            check_standby(compose)
    except (Failed, subprocess.TimeoutExpired) as failure:
        say(f"compose-test failed: {failure}")
        return 1
    say(f"compose-test passed in {time.monotonic() - started:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
