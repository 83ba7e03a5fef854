"""`replay` finds what does not agree, and nothing where all does."""

import sqlite3
import subprocess
import sys
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from crkr.protocol import StorageError, TaskSpec, Trial
from crkr.server.data_commands import backup, replay
from crkr.server.learning.radii_cache import save_radii
from crkr.server.learning.restore import restore
from crkr.server.log import PendingReport, SqliteLog

AXIS = {"name": "x", "unit": "m", "low": 0.0, "high": 1.0, "lengthscale": 0.1}
SPEC = TaskSpec.from_dict(
    {
        "name": "reach",
        "state": [AXIS, {**AXIS, "name": "y"}],
        "goal": [AXIS],
        "outcome": [{"name": "miss", "tolerance": 0.1}],
        "budget": 30,
    }
)


def trials(first: int, count: int) -> tuple[Trial, ...]:
    rng = np.random.default_rng(first)
    return tuple(
        Trial.create(
            SPEC,
            id=UUID(int=first + n),
            state=rng.uniform(size=2),
            goal=rng.uniform(size=1),
            cost=float(rng.uniform()),
            success=bool(rng.uniform() < 0.8),
            kind="demonstration" if n < 3 else "trial",
            outcome=rng.normal(size=1),
        )
        for n in range(count)
    )


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A log with everything in it, and the radii kept beside it."""
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    log.append_reports([PendingReport("reach", trials(0, 200))])
    log.append_event("reach", "recost", {"ids": [UUID(int=5), UUID(int=9)], "costs": [0.0, 0.9], "reason": ""})
    log.append_event("reach", "remove", {"ids": [UUID(int=7)], "reason": ""})
    judged = {"cost": 0.5, "success": False, "kind": "trial", "learn": True, "outcome": None, "removed": False}
    log.append_event("reach", "amend", {"ids": [UUID(int=8), UUID(int=9)], "values": [judged, judged], "reason": ""})
    log.append_event("reach", "fit", {"lengthscales": [0.2, 0.15], "signal_variance": 0.5})
    log.append_event("reach", "configure", {"changes": {"budget": 25}})
    log.append_reports([PendingReport("reach", trials(1000, 50))])
    radii = restore(log.reads, "reach").learner.radii()
    assert radii is not None
    save_radii(log, "reach", radii)
    log.close()
    return tmp_path / "data"


def replayed(data: Path, *options: str) -> str:
    app = typer.Typer()
    app.command()(replay)
    result = CliRunner().invoke(app, [str(data), *options], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_a_sound_directory_agrees_also_while_a_server_holds_it(data: Path) -> None:
    log = SqliteLog(data)
    assert "log and model agree" in replayed(data)
    assert '"agree": true' in replayed(data, "--json")
    log.close()


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE trial SET present_cost = 0.5 WHERE seq = 20", "20 does not match its digest"),
        ("UPDATE trial SET digest = substr(digest, 1, 16), present_cost = 0.5 WHERE seq = 20", "another cost"),
        ("UPDATE trial SET digest = substr(digest, 1, 16), removed = 0", "another cost or mark"),
        ("DELETE FROM trial WHERE seq = 30", "lacks position 30"),
        ("DELETE FROM trial WHERE seq = (SELECT max(seq) FROM trial)", "were acknowledged: its end is lost"),
    ],
)
def test_what_does_not_agree_is_named(data: Path, statement: str, says: str) -> None:
    with sqlite3.connect(data / "crkr.sqlite3") as connection:
        connection.execute(statement)
    connection.close()
    with pytest.raises(StorageError, match=says):
        replayed(data)


def test_radii_that_are_not_the_logs_are_named(data: Path) -> None:
    log = SqliteLog(data)
    radii = restore(log.reads, "reach").learner.radii()
    assert radii is not None
    radii.squared[4] += 1.0
    save_radii(log, "reach", radii)
    log.close()
    with pytest.raises(StorageError, match="radii"):
        replayed(data)


def test_a_backup_replays_like_its_original(data: Path, tmp_path: Path) -> None:
    app = typer.Typer()
    app.command()(backup)
    (tmp_path / "restored").mkdir()
    target = tmp_path / "restored" / "crkr.sqlite3"
    assert CliRunner().invoke(app, [str(data), str(target)], catch_exceptions=False).exit_code == 0
    assert replayed(tmp_path / "restored", "--json") == replayed(data, "--json")


def test_a_backup_for_which_there_is_no_room_leaves_nothing_behind(data: Path, tmp_path: Path) -> None:
    target = tmp_path / "backups" / "monday.sqlite3"
    target.parent.mkdir()
    command = [sys.executable, "-m", "crkr.client", "backup", str(data), str(target)]
    # 35 kB: more than the index of the write-ahead log needs, less than the log
    limited = ["sh", "-c", 'ulimit -f 70; exec "$@"', "sh", *command]
    done = subprocess.run(limited, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: cannot back up to {target}: ")
    assert list(target.parent.iterdir()) == []


def test_a_directory_without_a_log_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="no task log"):
        replayed(tmp_path)
