"""When a server opens its Zenoh session again, and when it gives the process up."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import zenoh_wire
from processes import Processes

from crkr.server.session_renewal import SessionRenewal

PATIENCE_S = 60.0
MOST_FAILURES = 5  # in a row


# In a process of its own, as the broken sessions would keep this one from ending.
ATTACKED = """
import os, sys, threading
import zenoh
from zenoh_wire import changed_on_the_way
from crkr.server.session import open_session
from crkr.server.session_renewal import SessionRenewal, cut_connections, is_broken, works_alone

port, most = map(int, sys.argv[1:])
endpoint, over = f"tcp/127.0.0.1:{port}", threading.Event()
sessions, held, done = [open_session(endpoint, None)], [], []

def attack():
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("scouting/multicast/enabled", "false")
    # A worker's token becomes one on no key.
    with changed_on_the_way(port, lambda batch: batch.replace(b"live/worker", b"liv*/worker")) as changed:
        config.insert_json5("connect/endpoints", f'["{changed}"]')
        hostile = zenoh.open(config)
        held.append((hostile, hostile.liveliness().declare_token("crkr/@v1/task/reach/live/worker/w")))
        while not is_broken(sessions[-1]):
            list(hostile.get("crkr/@v1/task/reach/rpc/status", timeout=0.1))

def renew():
    closing = threading.Thread(target=sessions[-1].close, daemon=True)  # it panics or hangs
    closing.start()
    closing.join(1.0)
    cut_connections([endpoint])
    sessions.append(open_session(endpoint, None))
    done.append("renewed")
    if len(done) <= most:
        attack()

def broken():
    found = is_broken(sessions[-1])
    if not found:
        over.set()
    return found

def give_up():
    done.append("given-up")
    over.set()

attack()
SessionRenewal(renew, broken, give_up, works_alone).start()
over.wait()
print(*done, flush=True)
os._exit(0)
"""


class PanicException(BaseException):
    """Named as the binding's own."""


def never() -> bool:
    return False


def break_until_mended(renewal: SessionRenewal, broken: threading.Event, processes: Processes) -> None:
    renewal.start()
    broken.set()
    processes.wait_until(lambda: not broken.is_set())
    renewal.stop(PATIENCE_S)


@pytest.mark.parametrize("failures", [0, MOST_FAILURES - 1])
def test_a_session_that_is_broken_is_renewed_until_one_works(failures: int, processes: Processes) -> None:
    broken, done = threading.Event(), []

    def renew() -> None:
        done.append("renewed")
        if len(done) > failures:
            broken.clear()

    renewal = SessionRenewal(renew, broken.is_set, lambda: done.append("given up"), never)
    break_until_mended(renewal, broken, processes)
    assert done == ["renewed"] * (failures + 1)


@pytest.mark.parametrize("error", [None, PanicException(), OSError("the port is in use")])
def test_where_no_session_works_any_more_the_process_is_given_up(
    error: BaseException | None, processes: Processes
) -> None:
    broken, done = threading.Event(), []

    def renew() -> None:
        done.append("renewed")
        if error is not None:
            raise error

    def give_up() -> None:
        done.append("given up")
        broken.clear()

    # A port that is taken is no matter of panics: that Zenoh works elsewhere does not help.
    renewal = SessionRenewal(renew, broken.is_set, give_up, lambda: isinstance(error, OSError))
    break_until_mended(renewal, broken, processes)
    assert done == ["renewed"] * MOST_FAILURES + ["given up"]


@pytest.mark.parametrize("error", [None, PanicException()])
def test_while_zenoh_works_where_no_client_reaches_it_renewal_never_ends(
    error: BaseException | None, processes: Processes
) -> None:
    broken, done = threading.Event(), []

    def renew() -> None:
        done.append("renewed")
        if len(done) > MOST_FAILURES:
            broken.clear()
        elif error is not None:
            raise error

    renewal = SessionRenewal(renew, broken.is_set, lambda: done.append("given up"), lambda: True)
    break_until_mended(renewal, broken, processes)
    assert done == ["renewed"] * (MOST_FAILURES + 1)


def test_an_attempt_that_fails_while_the_server_stops_is_the_last(processes: Processes) -> None:
    stopping, done = threading.Event(), []

    def renew() -> None:
        done.append("renewed")
        assert stopping.wait(PATIENCE_S)
        raise PanicException

    renewal = SessionRenewal(renew, lambda: True, lambda: done.append("given up"), never)
    renewal.start()
    processes.wait_until(lambda: done)
    renewal.stop(0.0)
    stopping.set()
    renewal.stop(PATIENCE_S)
    assert done == ["renewed"]


def test_one_that_was_never_started_is_stopped_all_the_same() -> None:
    SessionRenewal(lambda: None, never, lambda: None, never).stop(PATIENCE_S)


def test_panics_that_pass_do_not_renew_the_session() -> None:
    renewed: list[None] = []
    renewal = SessionRenewal(lambda: renewed.append(None), never, lambda: None, never)
    renewal.start()
    for _ in range(100):  # at once
        renewal.note_panic(RuntimeError("called `Option::unwrap()` on a `None` value"))
    renewal.stop(PATIENCE_S)
    assert renewed == []


def test_a_panic_over_a_poisoned_lock_renews_the_session_at_once(processes: Processes) -> None:
    renewed: list[None] = []
    renewal = SessionRenewal(lambda: renewed.append(None), never, lambda: None, never)
    renewal.start()
    renewal.note_panic(RuntimeError("called `Result::unwrap()` on an `Err` value: PoisonError { .. }"))
    processes.wait_until(lambda: renewed)
    renewal.stop(PATIENCE_S)
    assert renewed == [None]


def test_a_client_that_breaks_each_new_session_does_not_end_the_service(free_port: int) -> None:
    environment = {**os.environ, "PYTHONPATH": str(Path(zenoh_wire.__file__).parent)}
    command = [sys.executable, "-c", ATTACKED, str(free_port), str(MOST_FAILURES)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.split() == ["renewed"] * (MOST_FAILURES + 1)
