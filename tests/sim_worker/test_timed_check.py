"""Skills that do what they like with their process: a check ends within its limit and says so, and so does a run."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from processes import Processes, wait_until

from crkr.client import Task

SKILL = """
import itertools, os, signal, sys, threading
from pathlib import Path
from crkr.sim_worker import SkillOptions, TrialResult
from crkr.protocol import TaskSpec

def left():
    pid = os.fork()
    if pid == 0:
        signal.pause()
    Path("left").write_text(str(pid))

class Odd:
    def __init__(self, options):
        axis = [{{"name": "x", "low": 0.0, "high": 1.0}}]
        self.own = options.applied_to(TaskSpec.from_dict({{"name": "odd", "state": axis, "goal": axis}}))

    def spec(self):
        return self.own

    def reset(self, rng):
        return rng.uniform(size=1)

    def execute(self, goal):
        {body}
        return TrialResult(0.1, True, True)

make = Odd
"""
DEEP = """sys.setrecursionlimit(10**9)
        def deeper(n): return deeper(n + 1)
        deeper(0)"""
DEAF = """for each in (signal.SIGINT, signal.SIGTERM): signal.signal(each, signal.SIG_IGN)
        while True: pass"""
BLOCKS = "signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 65)); threading.Event().wait()"
TALKS = "while True: print('again')"
CLOSES = "os.closerange(0, 256)"
LOCKS = "sum(itertools.repeat(0))  # in C, which lets no other thread run"
WRITES = """for each in range(3, 64):
            try: os.write(each, bytes([0, 16, 0, 0]))
            except OSError: pass
        threading.Event().wait()"""
STOPS = "os.kill(os.getpid(), signal.SIGSTOP)"
LATE = "did not end within 1 s"


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (DEEP, f"a trial {LATE}; it is at odd.py, line "),
        (DEAF, f"a trial {LATE}; it is at odd.py, line "),
        (LOCKS, f"a trial {LATE}; it is at odd.py, line "),
        (BLOCKS, f"a trial {LATE}; --timeout allows more"),
        (STOPS, f"a trial {LATE}; --timeout allows more"),
        (TALKS, f"a trial {LATE}"),
        (CLOSES, "the skill ended its process"),
        (WRITES, "the skill ended its process, which ended: its pipe to this process broke"),
        ("os._exit(3)", "the skill ended its process, which ended with status 3"),
        ("left(); os.kill(os.getpid(), signal.SIGSEGV)", "ended its process, which was killed by SIGSEGV"),
    ],
    ids=["deep", "deaf", "locks", "blocks", "stops", "talks", "closes", "writes", "exits", "leaves"],
)
def test_no_skill_outlives_its_limit(tmp_path: Path, body: str, says: str) -> None:
    status, output = checked(tmp_path, body)
    assert status == 1
    assert output.splitlines()[-1].startswith("problem  execute: ")
    assert says in output.splitlines()[-1]
    assert_nothing_is_left(tmp_path)


@pytest.mark.parametrize("body", ["threading.Thread(target=threading.Event().wait).start()", "left()"])
def test_what_a_good_skill_leaves_behind_ends_with_the_check(tmp_path: Path, body: str) -> None:
    status, output = checked(tmp_path, body)
    assert (status, output.splitlines()[-1][:2]) == (0, "ok")
    assert_nothing_is_left(tmp_path)


def checked(folder: Path, body: str) -> tuple[int, str]:
    """Status and standard output of a check."""
    (folder / "odd.py").write_text(SKILL.format(body=body))
    command = [sys.executable, "-m", "crkr.client", "check-skill", "odd:make", "--timeout", "1"]
    done = subprocess.run(
        command, cwd=folder, text=True, check=False, timeout=100, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    return done.returncode, done.stdout


def assert_nothing_is_left(folder: Path) -> None:
    left = folder / "left"
    if left.exists():
        with pytest.raises(ProcessLookupError):
            os.kill(int(left.read_text()), 0)


@pytest.mark.parametrize("ending", ["os._exit(3)", LOCKS])
def test_the_end_of_a_worker_whose_children_hold_its_pipes_is_noticed(
    tmp_path: Path, start_command: Callable[..., Any], task: Task, shared_endpoint: str, ending: str
) -> None:
    (tmp_path / "odd.py").write_text(SKILL.format(body=f"left(); {ending}").replace('"left"', f'"{tmp_path}/left"'))
    words = ("--task", task.name, "--connect", shared_endpoint, "--stall", "1", "--timeout", "1", "--evaluations", "0")
    status, _, log = start_command("workers", f"{tmp_path}/odd.py:make", *words).finish()
    assert status == 1
    told = "ended with status 3" if "exit" in ending else "made no progress for"
    assert [told in line for line in log.splitlines() if line.startswith("warning: worker 0")] == [True]
    assert_nothing_is_left(tmp_path)


def test_a_worker_that_lets_no_thread_run_ends_with_its_supervisor(
    tmp_path: Path, start_command: Callable[..., Any], task: Task, shared_endpoint: str, processes: Processes
) -> None:
    body = f"Path('{tmp_path}/at').touch(); {LOCKS}"
    (tmp_path / "odd.py").write_text(SKILL.format(body=body))
    words = ("--task", task.name, "--connect", shared_endpoint, "--evaluations", "0")
    command = start_command("workers", f"{tmp_path}/odd.py:make", *words)
    wait_until((tmp_path / "at").exists, command.log)
    [worker] = command.members()
    command.process.kill()
    command.process.wait()
    wait_until(lambda: not processes.running([worker]), command.log)


def test_an_evaluation_ends_by_an_interrupt_or_with_its_process(
    tmp_path: Path, start_command: Callable[..., Any], task: Task, shared_endpoint: str
) -> None:
    bad, at = tmp_path / "bad", tmp_path / "at"
    skill = f"{tmp_path}/odd.py:make"
    Path(tmp_path / "odd.py").write_text(
        SKILL.format(
            body=f"""if Path('{bad}').exists():
            left()
            Path('{at}').touch()
            exec(Path('{bad}').read_text())"""
        ).replace('"left"', f'"{tmp_path}/left"')
    )
    server = ("--connect", shared_endpoint)
    words = ("--task", task.name, "--trials", "5", "--evaluations", "0", *server)
    assert start_command("workers", skill, *words).finish()[0] == 0
    bad.write_text("os._exit(3)")
    status, _, log = start_command("evaluate", task.name, "--contexts", "4", *server).finish()
    assert (status, "a process was lost; nothing was stored" in log) == (1, True)
    assert_nothing_is_left(tmp_path)
    at.unlink()
    bad.write_text(LOCKS)
    command = start_command("evaluate", task.name, "--contexts", "4", *server)
    wait_until(at.exists, command.log)
    command.process.send_signal(signal.SIGINT)
    status, _, log = command.finish()
    assert (status, log.splitlines()[-1]) == (130, "interrupted")
    assert_nothing_is_left(tmp_path)
