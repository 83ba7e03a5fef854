"""Whatever happens to its files, a server starts with all that it acknowledged or says what is damaged."""

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crkr.protocol import StorageError, TaskSpec, Trial
from crkr.server.learning.radii_cache import save_radii
from crkr.server.learning.restore import restore, restore_all
from crkr.server.log import PendingReport, SqliteLog, Stored

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Start = Callable[..., Any]
Damage = Callable[[Path, np.random.Generator], object]

LOG, WAL, TALLY = "crkr.sqlite3", "crkr.sqlite3-wal", "acknowledged"
SECTOR, PAGE = 512, 4096
ADVICE = ("restore a backup", "choose another --data", "use a newer crkr")
TRIALS = 400  # commits enough that part of the write-ahead log went into the database and part did not


@pytest.fixture
def left(
    start_server: Start, connect: Callable[[str], Ask], make_trial: MakeTrial, reach: dict[str, Any], tmp_path: Path
) -> Callable[[signal.Signals], Path]:
    """A data directory as a server leaves it, by signal; what it acknowledged is `acknowledged(make_trial)`."""

    def leave(how: signal.Signals) -> Path:
        server = start_server()
        ask = connect(server.endpoint)
        ask("rpc/create_task", {**reach, "name": "other"})
        ask("rpc/create_task", reach)
        for trial in acknowledged(make_trial):
            assert ask("task/reach/rpc/report", {"trials": [trial]})["accepted"] == 1
        ids = [trial["id"] for trial in acknowledged(make_trial)]
        assert ask("task/reach/admin/recost", {"ids": ids[:3], "costs": [0.5] * 3})["changed"] == 3
        assert ask("task/reach/admin/remove", {"ids": ids[5:7]})["removed"] == 2
        server.process.send_signal(how)
        server.process.wait(timeout=60)
        (server.data / "crkr.sqlite3-shm").unlink(missing_ok=True)  # shared memory, which SQLite creates again
        return Path(server.data)

    return leave


def acknowledged(make_trial: MakeTrial) -> list[dict[str, Any]]:
    told = {"worker": "ada", "model_version": 3, "info": {"reason": "hit" * 20}}
    return [make_trial(number, **told) for number in range(TRIALS)]


def content(data: Path, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """All that a server makes of its files: models, samples as it hands them out, and what it calls a duplicate."""
    log, found = SqliteLog(data), dict[str, Any]()
    try:
        for task in restore_all(log.reads):
            samples, after = log.reads.page(task.name, 0, 10**6, 2**40)
            events = [(entry.seq, entry.time) for entry in log.reads.read(task.name)]
            found[task.name] = (after, task.learner.active_ids, task.spec.to_dict(), samples, events)
            if task.name == "reach":
                again = tuple(Trial.from_wire(trial, task.created) for trial in trials)
                [result] = log.append_reports([PendingReport("reach", again)])
                assert isinstance(result, Stored)
                found["again"] = (result.seqs, len(result.fresh))
        return found
    finally:
        log.close()


def some(path: Path, rng: np.random.Generator, unit: int = 1) -> int:
    """A random place in a file, a multiple of `unit`."""
    return int(rng.integers(max(1, path.stat().st_size // unit))) * unit


def written(path: Path, place: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(place)
        file.write(data)


def flip(path: Path, rng: np.random.Generator) -> None:
    """One bit."""
    place = some(path, rng)
    written(path, place, bytes([path.read_bytes()[place] ^ 1 << int(rng.integers(8))]))


def flip_early(path: Path, rng: np.random.Generator) -> None:
    """One bit where headers, table definitions and small tables are."""
    place = int(rng.integers(min(8 * PAGE, path.stat().st_size)))
    written(path, place, bytes([path.read_bytes()[place] ^ 1 << int(rng.integers(8))]))


def swap(path: Path, rng: np.random.Generator) -> None:
    """Two pages, each intact."""
    whole = path.read_bytes()
    one, other = some(path, rng, PAGE), some(path, rng, PAGE)
    written(path, one, whole[other : other + PAGE])
    written(path, other, whole[one : one + PAGE])


def cut(path: Path, rng: np.random.Generator) -> None:
    written(path, 0, b"")
    with path.open("r+b") as file:
        file.truncate(some(path, rng))


DAMAGES: tuple[Damage, ...] = (
    flip,
    flip_early,
    swap,
    cut,
    lambda path, rng: written(path, some(path, rng, SECTOR), bytes(SECTOR)),
    lambda path, rng: written(path, some(path, rng, SECTOR), rng.bytes(SECTOR)),
    lambda path, rng: written(path, some(path, rng, PAGE), bytes(PAGE)),
    lambda path, rng: written(path, some(path, rng, PAGE), rng.bytes(PAGE)),
    lambda path, rng: written(path, path.stat().st_size, rng.bytes(int(rng.integers(1, 3 * PAGE)))),
    lambda path, rng: path.write_bytes(rng.bytes(path.stat().st_size)),
    lambda path, _: path.write_bytes(b""),
    lambda path, _: path.unlink(),
)


def damaged(data: Path, copy: Path, seed: int) -> str:
    """Damages a copy of a data directory in one place; says how."""
    shutil.copytree(data, copy)
    rng = np.random.default_rng(seed)
    names = [name for name in (LOG, WAL, TALLY) if (copy / name).exists()]
    name = names[rng.choice(len(names), p=np.array([8, 6, 1][: len(names)]) / sum([8, 6, 1][: len(names)]))]
    number = int(rng.integers(len(DAMAGES)))
    DAMAGES[number](copy / name, rng)
    return f"seed {seed}: damage {number} of {name}"


def undamaged_or_refused(data: Path, trials: list[dict[str, Any]], times: int, copies: Path) -> None:
    """Damages copies in random places; each is as good as the original or is refused with its name and advice."""
    copies.mkdir()
    shutil.copytree(data, copies / "intact")
    truth = content(copies / "intact", trials)
    assert truth["again"] == (tuple(range(2, len(trials) + 2)), 0)
    refused: list[tuple[str, str]] = []
    for seed in range(times):
        copy = copies / str(seed)
        done = damaged(data, copy, seed)
        try:
            assert content(copy, trials) == truth, done
        except StorageError as error:
            refused.append((done, error.message))
        shutil.rmtree(copy)
    assert times / 4 < len(refused) < times
    for done, message in refused:
        assert str(copies) in message or "the trial at log position" in message, (done, message)
        assert any(advice in message for advice in ADVICE), (done, message)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize(
    "times", [40, pytest.param(1300, marks=[pytest.mark.campaign, pytest.mark.timeout(600)])], ids=["short", "long"]
)
def test_a_log_damaged_anywhere_is_whole_or_refused(
    times: int, how: signal.Signals, left: Callable[[signal.Signals], Path], make_trial: MakeTrial, tmp_path: Path
) -> None:
    undamaged_or_refused(left(how), acknowledged(make_trial), times, tmp_path / "copies")


@pytest.mark.campaign
@pytest.mark.timeout(600)
def test_a_long_log_damaged_anywhere_is_whole_or_refused(
    make_trial: MakeTrial, reach: dict[str, Any], tmp_path: Path
) -> None:
    spec = TaskSpec.from_dict(reach)
    trials = [make_trial(number, worker="ada", info={"reason": "hit"}) for number in range(7000)]
    log = SqliteLog(tmp_path / "data")
    log.create(spec)
    for first in range(0, 7000, 1000):
        report = tuple(Trial.from_wire(trial, spec) for trial in trials[first : first + 1000])
        log.append_reports([PendingReport("reach", report)])
        if first == 5000:
            radii = restore(log.reads, "reach").learner.radii()
            assert radii is not None
            save_radii(log, "reach", radii)
    shutil.copytree(tmp_path / "data", tmp_path / "left")  # as a kill would leave it
    log.close()
    (tmp_path / "left" / "crkr.sqlite3-shm").unlink()
    undamaged_or_refused(tmp_path / "left", trials, 150, tmp_path / "copies")


LOST_ENDS: tuple[Callable[[Path], object], ...] = (
    lambda data: (data / WAL).unlink(),
    lambda data: (data / WAL).write_bytes(
        (data / WAL).read_bytes()[: 3 * PAGE]
    ),  # its end may be older than its beginning
    lambda data: (data / LOG).write_bytes(b""),
    lambda data: (data / LOG).unlink(),
)


def test_a_server_refuses_a_log_that_lost_its_end_and_leaves_it_as_it_is(
    left: Callable[[signal.Signals], Path], tmp_path: Path
) -> None:
    whole = left(signal.SIGKILL)
    for number, damage in enumerate(LOST_ENDS):
        data = tmp_path / f"copy {number}"
        shutil.copytree(whole, data)
        damage(data)
        before = {path.name: path.read_bytes() for path in data.iterdir() if path.name in (LOG, WAL, TALLY)}
        command = [sys.executable, "-m", "crkr.client", "server", "--data", str(data), "--listen", "tcp/127.0.0.1:0"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr.count("\n") == 1
        for part in (
            f"task log {data / LOG} holds",
            "404 were acknowledged",
            "restore a backup",
            f"delete {data / TALLY}",
        ):
            assert part in done.stderr
        assert {path.name: path.read_bytes() for path in data.iterdir() if path.name in before} == before


def test_what_is_left_of_a_log_may_be_used_where_its_owner_says_so(left: Callable[[signal.Signals], Path]) -> None:
    data = left(signal.SIGKILL)
    (data / WAL).unlink()
    with pytest.raises(StorageError, match="404 were acknowledged"):
        SqliteLog(data)
    (data / TALLY).unlink()
    log = SqliteLog(data)
    assert 0 < sum(log.reads.positions().values()) < 404
    restore_all(log.reads)
    log.close()
