"""The parts of `crkr bench dashboard` measure what they say, on real processes; how fast they are is not tested."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crkr.client import Client
from crkr.client.bench import workload
from crkr.dashboard.bench.children import commanded, started
from crkr.dashboard.bench.follower import Meter, Nothing, growth
from crkr.dashboard.bench.measure import FOLLOWER, SOURCE
from crkr.dashboard.progress import Progress
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import StoredTrial, Unavailable, pack

Message = Callable[..., dict[str, Any]]


def test_a_stream_is_published_at_its_rate_and_drawn_by_who_follows_it(
    server: Any, processes: Any, message: Message, tmp_path: Path
) -> None:
    file, contents = tmp_path / "run.rrd", [pack(message(1)), pack(message(2, kind="failed", cost=None))]
    (tmp_path / "messages").write_bytes(pack({"messages": contents}))
    with started(SOURCE, server.endpoint, str(tmp_path / "messages"), "100") as source:
        with (
            started(FOLLOWER, server.endpoint, workload.TASK, "--save", str(file)) as drawing,
            started(FOLLOWER, server.endpoint, workload.TASK) as bare,
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


def test_a_lag_is_from_the_arrival_to_the_end_of_the_tick_that_drew_it(stored: Any, message: Message) -> None:
    drawn: list[int] = []

    class Slow:
        def __getattr__(self, name: str) -> Any:
            return getattr(Nothing(), name)

        def picture(self, row: Any, telemetry: Any) -> None:
            drawn.append(row.seq + 0 * telemetry.seq)

    arrivals, progress = {2: -1e9, 3: -2e9}, Progress()
    meter = Meter(Slow(), arrivals)
    for seq in (2, 3):
        trial: StoredTrial = stored(seq)
        meter.picture(progress.add(trial, 0.0), Telemetry.from_wire(message(seq)))
    assert not meter.lags
    meter.tick(0.0, progress)
    meter.tick(1.0, progress)
    assert drawn == [2, 3]
    assert list(meter.lags) == pytest.approx([1e9, 2e9], rel=1e-2)
    assert arrivals == {}


def test_growth_is_the_slope_of_the_late_part() -> None:
    sizes = [(float(second), 5e7 + 4e6 * min(second, 4) + 1000.0 * second, 50 * second) for second in range(16)]
    assert growth(sizes) == pytest.approx((1000.0, 20.0))
    assert np.isnan(growth(sizes[:2])).all()


def test_a_command_that_ends_by_itself_is_told_with_its_last_words(free_port: int) -> None:
    arguments = ["status", "--timeout", "0.2", "--connect", f"tcp/127.0.0.1:{free_port}"]
    with pytest.raises(Unavailable, match=r"crkr status ended: .*"), commanded(arguments, "never said"):
        pytest.fail("it began")


def test_a_program_that_does_not_start_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(Unavailable, match="did not start"), started(SOURCE, "tcp/127.0.0.1:1", str(tmp_path), "no"):
        pytest.fail("it began")


def test_workers_that_cannot_start_are_one_line() -> None:
    command = [sys.executable, "-m", "crkr.client", "bench", "dashboard", "--skill", "no-such-skill", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: crkr workers ended")
    assert "no-such-skill" in line
