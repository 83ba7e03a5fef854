"""A run shown from its data directory."""

import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import EntryPoints
from pathlib import Path
from typing import Any

import pytest
from processes import RunningServer
from rerun.chunk import RrdReader

from crkr.client import Task
from crkr.dashboard import EpochResult, Progress, Row, stored_session
from crkr.dashboard.stored_session import open_run, replay
from crkr.protocol import Unsupported

Make = Callable[..., Any]


class Witness:
    """A view that keeps what it is told."""

    def __init__(self) -> None:
        self.progress = Progress()
        self.told: list[tuple[str, Any]] = []
        self.rows: list[Row] = []

    def task(self, description: str) -> None:
        self.told.append(("task", description))

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        self.rows += rows
        self.progress = progress

    def picture(self, row: Row, telemetry: Any) -> None:
        self.told.append(("picture", (row, telemetry)))

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        self.told.append(("epoch", (result.epoch, result.balls)))
        self.progress = progress

    def status(self, status: Any, progress: Progress, now: float) -> None:
        self.told.append(("status", (status["seq"], progress.seq, now)))

    def say(self, message: str, *, warning: bool = False) -> None:
        self.told.append(("warning" if warning else "say", message))

    def tick(self, now: float, progress: Progress) -> None:
        self.told.append(("tick", now))
        self.progress = progress

    def of(self, kind: str) -> list[Any]:
        return [value for name, value in self.told if name == kind]


class Stored:
    """A run in memory, in pages of what size is asked for."""

    def __init__(self, trials: list[Any], spec: Any) -> None:
        self.spec = spec
        self.last = trials[-1].seq
        self._trials = trials

    def pages(self, size: int) -> Iterator[tuple[list[Any], dict[str, Any]]]:
        for first in range(0, len(self._trials), size):
            page = self._trials[first : first + size]
            yield page, {"seq": page[-1].seq}

    def close(self) -> None:
        self._trials = []


def ball(stored: Make, seq: int, epoch: int) -> Any:
    return stored(seq, "evaluation", info={"epoch": epoch, "outcomes": {"hit": True}})


def test_every_trial_is_shown_once_in_order_at_the_time_it_was_stored(stored: Make, spec: Any) -> None:
    witness, done = Witness(), list[int]()
    progress = replay(Stored([stored(seq) for seq in range(2, 102)], spec), witness, lambda: True, done.append)
    assert [row.seq for row in witness.rows] == list(range(2, 102))
    assert progress.trials == 100
    assert witness.of("status") == [(seq, seq, 1000.0 + seq) for seq in done]
    assert witness.of("tick") == [1000.0 + seq for seq in done]
    assert done[-1] == 101
    assert any("no poses" in line for line in witness.of("say"))


def test_evaluations_that_workers_play_at_once_are_shown_whole(stored: Make, spec: Any) -> None:
    """The next one begins while the last balls of one are in play."""
    epochs = [0] * 48 + [1, 0, 1, 0] + [1] * 47 + [2, 1] + [2] * 30
    trials = [ball(stored, seq, epoch) for seq, epoch in enumerate(epochs, start=2)]
    witness = Witness()
    replay(Stored(trials, spec), witness, lambda: True, lambda _: None)
    assert witness.of("epoch") == [(0, 50), (1, 50), (2, 31)]


def test_a_replay_stops_between_pages(stored: Make, spec: Any) -> None:
    witness = Witness()
    answers = iter([True, True, False])
    progress = replay(
        Stored([stored(seq) for seq in range(2, 202)], spec), witness, lambda: next(answers), lambda _: None
    )
    assert progress.trials == len(witness.rows) == 50


def test_without_the_server_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(stored_session, "entry_points", lambda **_: EntryPoints())
    with pytest.raises(Unsupported, match=r"crkr\[server\]"):
        open_run(str(tmp_path), "crane")


def fill(task: Task) -> None:
    for number in range(60):
        task.report(
            state=[number / 6],
            goal=[0.1],
            cost=number / 60,
            success=number % 4 != 0,
            worker=f"crane-{number % 2}",
            info={"reason": "lifted" if number % 4 else "stuck"},
            wait=number == 59,
        )
    for epoch in (0, 1):
        for number in range(5):
            info = {"epoch": epoch, "ball": number, "outcomes": {"level": number < 2 + epoch}}
            task.report(state=[1.0], goal=[0.1], cost=0.3, success=True, kind="evaluation", info=info)


def run(directory: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "crkr.client", "watch", "crane", "--replay", str(directory), *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def numbers(file: Path, entity: str) -> list[float]:
    """An entity's numbers in a complete recording."""
    reader = RrdReader(str(file))
    (store,) = reader.recordings()
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=store).filter(content=entity).to_chunks()]
    found = [
        batch.column("Scalars:scalars").to_pylist() for batch in batches if "Scalars:scalars" in batch.schema.names
    ]
    return [row[0] for rows in found for row in rows]


def test_a_stopped_servers_run_is_recorded_whole(server: RunningServer, crane: Task, tmp_path: Path) -> None:
    fill(crane)
    status = crane.status()
    server.process.send_signal(signal.SIGTERM)
    server.process.wait(60)
    file = tmp_path / "run.rrd"
    done = run(server.data, "--save", str(file))
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert done.stderr.splitlines() == [f"recording: {file}"]
    failed = [number / 60 for number in range(60) if number % 4 == 0]
    assert numbers(file, "/cost/failure") == pytest.approx(failed)
    assert len(numbers(file, "/cost/success")) == 45
    assert numbers(file, "/evaluation/level/rate") == [0.4, 0.6]
    assert numbers(file, "/reasons/stuck")[-1] == 0.24
    assert numbers(file, "/learner/active")[-1] == status["active"]
    assert numbers(file, "/learner/eligible")[-1] == status["eligible"] == 45


def test_the_final_tables_are_printed_beside_a_server_that_goes_on(server: RunningServer, crane: Task) -> None:
    fill(crane)
    done = run(server.data, "--terminal")
    assert done.returncode == 0, done.stderr
    text = re.sub(r"[\s│]+", " ", done.stdout)
    for expected in (
        "training trials 60",
        "lifted 45 75 %",
        "level ▄▅",
        "40 % 60 %",
        "crane-0",
        "no poses",
        "Lift loads.",
    ):
        assert expected in text, done.stdout
    assert crane.report(state=[1.0], goal=[0.1], cost=0.5, success=True).accepted == 1


def test_the_page_stays_until_it_is_stopped(server: RunningServer, crane: Task, tmp_path: Path) -> None:
    fill(crane)
    command = [sys.executable, "-m", "crkr.client", "watch", "crane", "--replay", str(server.data)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            (address,) = [process.stderr.readline()]
            with urllib.request.urlopen(address.removeprefix("viewer: ").split("?")[0], timeout=60) as answer:
                assert answer.status == 200
            assert "all of it is shown" in process.stderr.readline()
            assert process.poll() is None
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("task", "directory", "says"),
    [
        ("crane", "missing", "error: there is no data directory "),
        ("crane", ".", "error: there is no task log "),
        ("crabe", "data", "holds no task 'crabe'; it has crane"),
    ],
)
def test_an_error_is_one_line_and_status_1(
    server: RunningServer, crane: Task, tmp_path: Path, task: str, directory: str, says: str
) -> None:
    where = server.data if directory == "data" else tmp_path / "empty" / directory
    (tmp_path / "empty").mkdir()
    command = [sys.executable, "-m", "crkr.client", "watch", task, "--terminal", "--replay", str(where)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert says in line


@pytest.mark.parametrize("option", [("--connect", "tcp/127.0.0.1:7447"), ("--patience", "3"), ("--timeout", "1")])
def test_options_of_a_server_are_wrong_usage(tmp_path: Path, option: tuple[str, str]) -> None:
    done = run(tmp_path, "--terminal", *option)
    assert done.returncode == 2
    assert f"leave out {option[0]}" in re.sub(r"[\s│]+", " ", done.stderr)
