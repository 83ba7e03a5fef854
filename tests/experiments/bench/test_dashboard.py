"""The parts of `crkr bench dashboard` measure what they say, on real processes; how fast they are is not tested."""

import subprocess
import sys
from pathlib import Path

import pytest
from processes import Processes, RunningServer

from crkr.client import Client
from crkr.experiments.bench import workload
from crkr.experiments.bench.dashboard import STREAM, WATCH
from crkr.experiments.bench.processes import command, program
from crkr.protocol import Unavailable, pack

# What a worker publishes about a trial, without poses.
MESSAGE = {"id": bytes(16), "seq": 1, "kind": "trial", "success": True, "worker": "w", "info": {"note": 500 * "x"}}


def test_a_stream_is_published_at_its_rate_and_drawn_by_a_watch(
    server: RunningServer, processes: Processes, tmp_path: Path
) -> None:
    file, contents = tmp_path / "run.rrd", [pack(MESSAGE), pack(MESSAGE | {"kind": "failed", "success": False})]
    (tmp_path / "messages").write_bytes(pack({"messages": contents}))
    with program(STREAM, server.endpoint, str(tmp_path / "messages"), "100") as source:
        with (
            program(WATCH, server.endpoint, workload.TASK, "--save", str(file)) as drawing,
            program(WATCH, server.endpoint, workload.TASK) as bare,
        ):
            with Client(server.endpoint) as client:
                task = client.task(workload.TASK)
                begin = task.status()["seq"]
                processes.wait_until(lambda: task.status()["seq"] > begin + 300)
            drawn, followed = drawing.finish(), bare.finish()
        sent = source.finish()
    assert 300 <= sent["published"] <= 100 * sent["seconds"]
    assert sent["bytes"] / sent["published"] == pytest.approx(len(contents[0]), rel=0.05)
    for found in (drawn, followed):
        assert 0 < found["drawn"] <= sent["published"]
        assert 0 < found["lag_p50_ms"] <= found["lag_p99_ms"]
    assert followed["recording_bytes"] == 0
    assert drawn["recording_bytes"] == file.stat().st_size > 100 * drawn["drawn"]


def test_the_error_of_a_command_that_ends_by_itself_has_its_last_line(free_port: int) -> None:
    arguments = ["status", "--timeout", "0.2", "--connect", f"tcp/127.0.0.1:{free_port}"]
    with pytest.raises(Unavailable, match=r"^crkr status ended with status 1: "), command(arguments, "never said"):
        pytest.fail("it began")


def test_a_program_that_does_not_start_is_an_error(tmp_path: Path) -> None:
    with (
        pytest.raises(Unavailable, match=r"bench\.stream ended with status 2: "),
        program(STREAM, "tcp/127.0.0.1:1", str(tmp_path), "no"),
    ):
        pytest.fail("it began")


def test_workers_that_cannot_start_are_one_line() -> None:
    command = [sys.executable, "-m", "crkr.client", "bench", "dashboard", "--skill", "no-such-skill", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: crkr workers ended")
    assert "no-such-skill" in line
