"""How a demo ends: each process is interrupted once and has the time that it needs."""

from pathlib import Path

from processes import Processes

from crkr.dashboard import command, poller, viewer
from crkr.sim_worker.demo import process, processes
from crkr.sim_worker.demo.process import DemoProcess


def test_watch_has_the_time_that_its_own_limits_add_up_to() -> None:
    longest = poller.ANSWER_S + poller.INTERRUPTED_S + viewer.ENDS_S + command.CLOSE_S
    assert longest < process.PATIENCE_S
    assert longest + 0.5 < processes.END_S < 5.0  # its own start of an end, and what it promises its user
    assert processes.WORKERS_END_S < processes.END_S - 1.5  # what the server gets when the workers take all of theirs


def test_a_process_is_interrupted_once_however_often_it_is_asked(tmp_path: Path, processes: Processes) -> None:
    """Its second SIGINT would end it where it stands; the first is enough for `crkr watch` to end in order."""
    nobody = ["--timeout", "0.5", "--connect", "tcp/127.0.0.1:1"]
    child = DemoProcess("watch", ["watch", "crane", "--terminal", *nobody], tmp_path)
    try:
        processes.wait_until(child.new_lines, child.log)  # it waits for a server, and looks up twice a second

        def has_ended() -> bool:
            child.interrupt()
            return child.status is not None

        processes.wait_until(has_ended, child.log)
    finally:
        child.end(0.0)
    assert child.status == 0
