"""How a process with a client ends: at once, whatever was forgotten; and what a fork of it may do."""

import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from processes import Processes

MakePeer = Callable[..., Any]
PATIENCE_S = 60.0  # no promise, just no hang
PROGRAM = """
import os, sys, threading
from crkr.client import Client
client = Client(sys.argv[1], timeout_s=30)
client.info()
print("connected", flush=True)
"""
FORK = """
child = os.fork()
if child == 0:
    {}
    sys.exit(7)
code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
client.info()
sys.exit(code)
"""


def start(program: str, endpoint: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", PROGRAM + program, endpoint],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Status and output of a process that must end by itself."""
    try:
        out, err = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        pytest.fail("the process did not end")
    return process.returncode, out, err


@pytest.mark.parametrize(
    ("forgotten", "status"),
    [
        ("pass", 0),
        ("s = client.task('a').subscribe(); t = client.task('a').announce('w')", 0),
        ("s = client.task('a').subscribe(); sys.exit(3)", 3),
        ("s = client.task('a').subscribe(); raise KeyError('lost')", 1),
        ("s = client.task('a').subscribe(); threading.Thread(target=s.receive, args=(60,), daemon=True).start()", 0),
    ],
    ids=["client", "subscription and token", "exit", "exception", "reader"],
)
def test_a_forgotten_close_does_not_keep_the_process(make_peer: MakePeer, forgotten: str, status: int) -> None:
    peer = make_peer([{}])
    code, _, err = finish(start(forgotten, peer.endpoint))
    assert code == status
    assert ("lost" in err) if status == 1 else not err


def test_a_call_in_a_daemon_thread_does_not_keep_the_process(make_peer: MakePeer) -> None:
    peer = make_peer([{}, "hold"])
    process = start(
        "threading.Thread(target=client.task('a').refit, daemon=True).start(); sys.stdin.readline()", peer.endpoint
    )
    assert finish(process)[0] == 0


def test_an_interrupt_ends_a_call_in_progress(make_peer: MakePeer, processes: Processes) -> None:
    peer = make_peer([{}, "hold"])
    process = start("client.task('a').refit()", peer.endpoint)
    assert process.stdout is not None
    assert process.stdout.readline() == "connected\n"
    processes.wait_until(lambda: len(peer.queries) >= 2)
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == -signal.SIGINT
    assert err.rstrip().endswith("KeyboardInterrupt")


def test_a_call_in_a_forked_child_is_refused_and_the_parent_goes_on(make_peer: MakePeer) -> None:
    peer = make_peer([{}])
    inside = """
    for make in (lambda: client, lambda: Client(sys.argv[1])):
        try:
            make().info()
        except Exception as error:
            print(type(error).__name__, "spawn" in str(error), flush=True)
"""
    code, out, err = finish(start(FORK.format(inside.strip()), peer.endpoint))
    assert (code, err) == (7, "")
    assert out.splitlines() == ["connected", "Unavailable True", "Unavailable True"]


@pytest.mark.parametrize("inside", ["pass", "client.close()", "del client", "s.close(); t.close(); client.close()"])
def test_a_forked_child_ends_whatever_it_inherited(make_peer: MakePeer, inside: str) -> None:
    peer = make_peer([{}])
    holding = "s = client.task('a').subscribe(); t = client.task('a').announce('w')\n"
    code, _, err = finish(start(holding + FORK.format(inside), peer.endpoint))
    assert (code, err) == (7, "")


ROBOT = """
import asyncio, os, signal, sys, tempfile, threading, time
import numpy as np
from crkr.client import AsyncClient, Client
client = Client(sys.argv[1], timeout_s=30)
task = client.create_task({"name": "toss-" + str(os.getpid()), "state": [{"name": "x", "low": 0, "high": 1}],
                           "goal": [{"name": "g", "low": 0, "high": 1}]})
task.report(state=[0.5], goal=[0.5], cost=0.5, success=True, wait=True)
mirror, outbox = task.mirror(pause_s=0.001, every_s=0.001), task.outbox(tempfile.mkdtemp() + "/box")
outbox.report(state=[0.5], goal=[0.5], cost=0.5, success=True)
print("connected", flush=True)
"""


def robot(program: str, endpoint: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", ROBOT + program, endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(
    ("forgotten", "status"),
    [
        ("pass", 0),
        ("client.close(); sys.exit(3)", 3),
        ("mirror.close(); sys.exit(3)", 3),
        ("outbox.close(); raise KeyError('lost')", 1),
        ("threading.Thread(target=outbox.flush, args=(60,), daemon=True).start()", 0),
        ("threading.Thread(target=mirror.wait_for, args=(10**9, 60), daemon=True).start()", 0),
    ],
)
def test_a_forgotten_mirror_or_outbox_does_not_keep_the_process(
    shared_endpoint: str, forgotten: str, status: int
) -> None:
    code, _, err = finish(robot(forgotten, shared_endpoint))
    assert code == status, err
    assert ("lost" in err) if status == 1 else not err


@pytest.mark.parametrize("before", ["", "client.close()", "mirror.refresh()"])
def test_an_interpreter_ends_while_daemons_predict(shared_endpoint: str, before: str) -> None:
    """Daemons end wherever they are, and in the C++ of scipy that would abort the process."""
    program = f"""
def predict():
    while True:
        mirror.predict([0.5])

for _ in range(3):
    threading.Thread(target=predict, daemon=True).start()
for _ in range(1000):
    mirror.predict([0.5])
{before}
"""
    for process in [robot(program, shared_endpoint) for _ in range(4)]:
        code, _, err = finish(process)
        assert (code, err) == (0, "")


FORGOTTEN_LOOP = """
import asyncio, sys
from crkr.client import AsyncClient

async def main():
    client = AsyncClient(sys.argv[1], timeout_s=60)
    await client.info()
    task = client.task("a")
    notices = await task.subscribe()
    waiting = [asyncio.create_task(each) for each in (task.refit(), notices.receive(60))]
    await asyncio.wait(waiting, timeout=0.3)
    print("leaving", flush=True)
    {}

asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("end", "status"), [("pass", 0), ("sys.exit(3)", 3), ("raise KeyError('lost')", 1), ("raise KeyboardInterrupt", -2)]
)
def test_a_loop_that_ends_with_calls_in_progress_does_not_keep_the_process(
    make_peer: MakePeer, end: str, status: int
) -> None:
    peer = make_peer([{}, "hold"])
    command = [sys.executable, "-c", FORGOTTEN_LOOP.format(end), peer.endpoint]
    code, out, err = finish(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
    assert (code, out) == (status, "leaving\n"), err
    assert err.count("Traceback") == (1 if status in (1, -2) else 0)


def test_a_forked_child_is_refused_by_mirror_outbox_and_loop_and_the_parent_goes_on(shared_endpoint: str) -> None:
    inside = """
    calls = [lambda: mirror.predict([0.5]), mirror.refresh, lambda: mirror.wait_for(10**9, 60), outbox.refused,
             lambda: outbox.flush(60), lambda: outbox.report(state=[0.5], goal=[0.5], cost=0.5, success=True),
             lambda: task.outbox(tempfile.mkdtemp() + "/other"), lambda: asyncio.run(loop.info())]
    for call in calls:
        try:
            call()
        except Exception as error:
            print(type(error).__name__, "spawn" in str(error), flush=True)
    mirror.close(); outbox.close(); client.close()
"""
    after = """
assert mirror.refresh(30) in (True, False) and mirror.predict([0.5]).active >= 1
outbox.report(state=[0.5], goal=[0.5], cost=0.5, success=True)
outbox.flush(30)
assert outbox.pending == 0
outbox.close(); mirror.close()
"""
    program = "loop = AsyncClient(sys.argv[1]); asyncio.run(loop.info())" + FORK.format(inside.strip())
    code, out, err = finish(robot(program.replace("client.info()\nsys", f"{after}\nsys"), shared_endpoint))
    assert (code, err) == (7, "")
    assert out.splitlines() == ["connected", *["Unavailable True"] * 8]


@pytest.mark.parametrize("after", ["client.close()", "outbox.close(); mirror.close(); client.close()"])
def test_a_fork_after_close_is_told_clearly_and_ends_at_once(shared_endpoint: str, after: str) -> None:
    """Zenoh's threads outlive a session, so that a child cannot open another one either."""
    inside = """
    del client, mirror, outbox, task
    try:
        Client(sys.argv[1]).info()
    except Exception as error:
        print(type(error).__name__, "spawn" in str(error), flush=True)
"""
    program = f"{after}\n" + FORK.format(inside.strip()).replace("client.info()\n", "")
    code, out, err = finish(robot(program, shared_endpoint))
    assert (code, err) == (7, "")
    assert out.splitlines() == ["connected", "Unavailable True"]


def test_importing_the_client_brings_neither_mathematics_nor_the_command() -> None:
    program = (
        "import sys; from crkr.client import Client; "
        "print([name for name in ('scipy', 'typer', 'rich', 'crkr.learner', 'crkr.server') if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=30)
    assert run.stdout == "[]\n"
