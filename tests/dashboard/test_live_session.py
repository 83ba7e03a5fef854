import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import FrameType
from typing import Any

import pytest
from processes import RunningServer

from crkr.client import Client, Task
from crkr.client.cli.stop_request import StopRequest
from crkr.dashboard import EpochResult, Feed, Progress, Row, Telemetry
from crkr.dashboard.live_session import follow, wait_for_task
from crkr.dashboard.poller import Poller
from crkr.protocol import TaskSpec, Unavailable, UnknownTask

Message = Callable[..., dict[str, Any]]
Publish = Callable[[str, dict[str, Any]], None]
DEADLINE_S = 60.0


@pytest.fixture
def alarm() -> Iterator[None]:
    """Fails a test that hangs; works while the main thread waits for a lock."""

    def ring(number: int, frame: object) -> None:
        pytest.fail("hangs")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, DEADLINE_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


class Witness:
    """A view that remembers; `enough` says when the loop may end."""

    def __init__(self) -> None:
        self.progress = Progress()
        self.pictures: list[Telemetry] = []
        self.statuses: list[Mapping[str, Any]] = []
        self.lines: list[tuple[bool, str]] = []
        self.started = time.monotonic()

    def task(self, description: str) -> None:
        self.lines.append((False, description))

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        self.progress = progress
        assert rows[-1].seq == progress.seq

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        assert row.seq == telemetry.seq
        self.pictures.append(telemetry)

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        self.progress = progress
        self.lines.append((False, f"epoch {result.epoch}"))

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        assert self.started <= now <= time.monotonic()
        self.progress = progress
        self.statuses.append(status)

    def say(self, message: str, *, warning: bool = False) -> None:
        self.lines.append((warning, message))

    def tick(self, now: float, progress: Progress) -> None:
        self.progress = progress
        assert now - self.started < DEADLINE_S, self.lines


def watched(endpoint: str, enough: Callable[[Witness, Feed], bool]) -> tuple[Witness, Feed]:
    witness = Witness()
    feed = Feed(witness)
    with Client(endpoint, timeout_s=1.0) as client:
        follow(client, client.task("crane"), feed, 0.02, lambda: not enough(witness, feed))
    return witness, feed


def report(task: Task, count: int) -> list[int]:
    receipt = task.report(
        state=[[5.0]] * count,
        goal=[[0.1]] * count,
        cost=0.5,
        success=True,
        worker="crane-1",
        info={"reason": "lifted"},
    )
    return list(receipt.seqs)


def test_earlier_trials_are_read_page_by_page(server: RunningServer, crane: Task) -> None:
    for _ in range(3):
        report(crane, 700)
    witness, _ = watched(server.endpoint, lambda seen, _: seen.progress.trials == 2100 and bool(seen.statuses))
    assert witness.progress.reasons == {"lifted": 2100}
    assert witness.statuses[0]["samples"]["trial"] == 2100


def test_publications_arrive_as_pictures_and_odd_ones_do_no_harm(
    server: RunningServer, crane: Task, publish: Publish, message: Message
) -> None:
    seqs = report(crane, 3)
    odd = [{}, {"seq": "x"}, message(seqs[0], trace={"time": 3}), message(seqs[0], scene=[7])]
    sent = threading.Event()

    def send(seen: Witness, feed: Feed) -> bool:
        """Publishes once somebody listens; the publisher is not told, so it tries until something arrives."""
        if not seen.pictures:
            publish("trial", message(seqs[0]))
        elif not sent.is_set():
            sent.set()
            for fields in odd:
                publish("trial", fields)
            publish("evaluation", message(seqs[1], kind="evaluation"))
            publish("trial", message(seqs[2]))
        return sent.is_set() and feed.skipped == len(odd) and {t.seq for t in seen.pictures} == set(seqs)

    witness, _ = watched(server.endpoint, send)
    assert {telemetry.kind for telemetry in witness.pictures} == {"trial", "evaluation"}
    assert all(telemetry.trace is not None for telemetry in witness.pictures)


def test_watching_continues_after_a_restart_of_the_server(
    start_server: Callable[..., Any], spec: TaskSpec, free_port: int
) -> None:
    first = start_server(port=free_port)
    steps = iter(["end", "start again", "done"])
    step = next(steps)

    def restart(seen: Witness, feed: Feed) -> bool:
        nonlocal step
        if step == "end" and seen.progress.trials == 2:
            step = next(steps)
            first.process.send_signal(signal.SIGTERM)
            first.process.wait(60)
        elif step == "start again" and any(warning for warning, _ in seen.lines):
            step = next(steps)
            start_server(port=free_port)
            with Client(f"tcp/127.0.0.1:{free_port}") as other:
                report(other.task("crane"), 3)
        return seen.progress.trials == 5

    with Client(first.endpoint) as client:
        report(client.create_task(spec), 2)
    witness, _ = watched(first.endpoint, restart)
    said = [warning for warning, line in witness.lines if "server" in line]
    assert said
    assert said == [True, False] * (len(said) // 2)  # lost and found; more than once where the machine is busy


def pollers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "crkr-poller"]


def test_a_question_to_a_silent_server_does_not_delay_the_end(server: RunningServer, crane: Task) -> None:
    report(crane, 1)
    server.process.send_signal(signal.SIGSTOP)
    try:
        with Client(server.endpoint, timeout_s=10 * DEADLINE_S) as client:
            with Poller(client.task("crane"), client.close):
                (thread,) = pollers()  # its first question is on its way
            thread.join(DEADLINE_S)
            assert not thread.is_alive()
    finally:
        server.process.send_signal(signal.SIGCONT)


def test_a_missing_server_is_waited_for_and_then_named(free_port: int) -> None:
    said: list[str] = []
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        Client(endpoint, timeout_s=0.5) as client,
        pytest.raises(Unavailable, match=r"did not appear within 1 s; start one: crkr server$"),
    ):
        wait_for_task(client, "crane", 1.0, StopRequest(), said.append)
    assert len(said) == 1
    assert str(free_port) in said[0]


def test_a_missing_task_is_waited_for_and_then_named(server: RunningServer) -> None:
    said: list[str] = []
    with Client(server.endpoint) as client, pytest.raises(UnknownTask, match="task 'crane' did not appear"):
        wait_for_task(client, "crane", 0.5, StopRequest(), said.append)
    assert said == ["waiting up to 0 s for task 'crane' ..."]


def test_a_signal_ends_the_wait(free_port: int) -> None:
    with StopRequest() as stop, Client(f"tcp/127.0.0.1:{free_port}", timeout_s=0.5) as client:
        found = wait_for_task(client, "crane", 60.0, stop, lambda _: os.kill(os.getpid(), signal.SIGTERM))
    assert found is None


def signalled_at(moment: int, client: Client) -> int:
    """Waits for a task, with a signal at a given line of Python after the first question; returns the lines run."""
    lines = 0

    def trace(frame: FrameType, event: str, argument: object) -> Any:
        nonlocal lines
        lines += event == "line"
        if lines < moment:
            return trace
        sys.settrace(None)
        os.kill(os.getpid(), signal.SIGTERM)
        return None

    def begin(_: str) -> None:
        sys._getframe(1).f_trace = trace  # of the wait, which calls this after its first question
        sys.settrace(trace)

    before = sys.gettrace()
    try:
        with StopRequest() as stop:
            assert wait_for_task(client, "crane", DEADLINE_S, stop, begin) is None
    finally:
        sys.settrace(before)
    return lines


@pytest.mark.usefixtures("alarm")
def test_a_signal_at_any_line_of_python_between_two_questions_ends_the_wait(server: RunningServer) -> None:
    with Client(server.endpoint) as client:
        assert [signalled_at(moment, client) for moment in range(1, 13)] == list(range(1, 13))


def test_signals_act_as_before_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopRequest():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before
