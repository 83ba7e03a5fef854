"""The log keeps what it was given, once and in order, and notices when somebody else changed it."""

import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from uuid import UUID

import pytest
from logged_trials import SPEC, trial, trials_of
from processes import wait_until

from crkr.protocol import StorageError
from crkr.server.learning.restore import restore, restore_all
from crkr.server.log import LoggedTrial, PendingReport, SqliteLog, Stored, read_log
from crkr.server.log.sqlite_database import SqliteDatabase


def test_of_two_backups_to_one_file_one_is_made_and_the_other_refused(log: SqliteLog, tmp_path: Path) -> None:
    log.append_reports([PendingReport("reach", tuple(trial(number) for number in range(1, 2000)))])
    target = tmp_path / "copies" / "monday.sqlite3"
    target.parent.mkdir()
    command = [sys.executable, "-m", "crkr.client", "backup", str(log.path.parent), str(target)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as late:
        wait_until(lambda: list(target.parent.iterdir()))
        late.send_signal(signal.SIGSTOP)
        begun = not target.exists()
        if begun:  # as if by the other
            target.write_bytes(b"the other")
        late.send_signal(signal.SIGCONT)
        _, told = late.communicate(timeout=60)
    assert (late.returncode, target.read_bytes() == b"the other") == (int(begun), begun)
    assert ("exists; choose another file" in told) == begun
    assert [path.name for path in target.parent.iterdir()] == ["monday.sqlite3"]


@pytest.fixture
def log(tmp_path: Path) -> Iterator[SqliteLog]:
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    yield log
    log.close()


def test_one_process_holds_a_directory(log: SqliteLog, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="in use by process"):
        SqliteLog(tmp_path / "data")


def test_a_backup_is_a_whole_log_of_its_own(log: SqliteLog, tmp_path: Path) -> None:
    log.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    (tmp_path / "restored").mkdir()
    target = tmp_path / "restored" / "crkr.sqlite3"
    SqliteDatabase(log.path).backup(target)
    log.append_reports([PendingReport("reach", (trial(3),))])
    with pytest.raises(StorageError, match="exists"):
        SqliteDatabase(log.path).backup(target)
    assert [path.name for path in target.parent.iterdir()] == ["crkr.sqlite3"]
    restored = SqliteLog(tmp_path / "restored")
    assert restored.reads.last("reach") == 3
    assert restored.reads.integrity() == []
    restored.close()


@pytest.fixture
def database(log: SqliteLog) -> Path:
    """A closed log of 300 trials."""
    log.append_reports([PendingReport("reach", tuple(trial(n) for n in range(1, 301)))])
    log.close()
    assert not log.path.with_name(log.path.name + "-wal").exists()
    return log.path


def changed(statement: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with sqlite3.connect(path) as connection:
            connection.execute(statement)
        connection.close()

    return change


def zeroed(path: Path, length: int) -> None:
    """Zeroes that many bytes of a page that holds trial 150."""
    data = bytearray(path.read_bytes())
    place = data.index(trial(150).state.tobytes())
    start = place // length * length
    data[start : start + length] = bytes(length)
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), "restore a backup"),
        (lambda path: path.write_bytes(b"no database at all " * 200), "not a database"),
        (lambda path: zeroed(path, 4096), "malformed"),
        (lambda path: zeroed(path, 1), "151 does not match its digest"),
        (changed("UPDATE trial SET cost = cost / 2 WHERE seq = 77"), "77 does not match its digest"),
        (changed("UPDATE trial SET worker = 'bob' WHERE seq = 78"), "78 does not match its digest"),
        (changed("UPDATE trial SET time = time + 1 WHERE seq = 78"), "78 does not match its digest"),
        (changed("UPDATE trial SET info = x'80' WHERE seq = 78"), "78 does not match its digest"),
        (changed("UPDATE trial SET removed = 1 WHERE seq = 78"), "78 does not match its digest"),
        (changed("UPDATE trial SET id = x'00112233445566778899aabbccddeeff' WHERE seq = 78"), "78 does not match"),
        (changed("UPDATE task SET name = 'other'"), "restore a backup"),
        (changed("DELETE FROM task"), "does not list"),
        (changed("DELETE FROM trial WHERE seq = 301"), "holds 300 entries, but 301 were acknowledged"),
        (changed("DELETE FROM trial WHERE seq = 100"), "lacks position 100"),
        (changed("DELETE FROM event"), "lacks position 1"),
        (changed("UPDATE event SET body = x'80'"), "does not match its digest"),
        (changed("PRAGMA user_version = 99"), "newer"),
        (changed("PRAGMA application_id = 1"), "another program"),
    ],
)
def test_a_damaged_or_foreign_log_is_refused_and_left_as_it_is(
    database: Path, damage: Callable[[Path], None], says: str
) -> None:
    damage(database)
    before = database.read_bytes()

    def start() -> None:
        log = SqliteLog(database.parent)
        try:
            restore_all(log.reads)
        finally:
            log.close()

    with pytest.raises(StorageError, match=says):
        start()
    assert database.read_bytes() == before


def test_a_log_of_the_first_schema_is_read_and_goes_on_in_the_present_one(database: Path) -> None:
    before = read_log(database)
    trials = [entry.trial.digest() for entry in before.read("reach") if isinstance(entry, LoggedTrial)]
    before.close()
    changed("UPDATE trial SET digest = substr(digest, 1, 16)")(database)
    changed("PRAGMA user_version = 1")(database)
    (database.parent / "acknowledged").unlink()
    log = SqliteLog(database.parent)
    restore_all(log.reads)
    assert [one.trial.digest() for one in trials_of(log)] == trials
    log.append_event("reach", "recost", {"ids": [UUID(int=5)], "costs": [0.25], "reason": ""})
    [stored] = log.append_reports([PendingReport("reach", (trial(1), trial(301)))])
    assert isinstance(stored, Stored)
    assert stored.seqs == (2, 303)
    log.close()
    with sqlite3.connect(database) as connection:
        sizes = connection.execute("SELECT length(digest), count(*) FROM trial GROUP BY 1 ORDER BY 1").fetchall()
        version = connection.execute("PRAGMA user_version").fetchone()
    connection.close()
    assert (sizes, version) == ([(16, 299), (24, 2)], (3,))  # what is new or changed is sealed


def test_the_cache_may_be_dropped_or_damaged(database: Path) -> None:
    log = SqliteLog(database.parent)
    log.save_cache("reach", 301, b"radii")
    log.close()
    changed("UPDATE cache SET data = x'00'")(database)
    log = SqliteLog(database.parent)
    assert log.reads.load_cache("reach") is None
    log.close()
    changed("DROP TABLE cache")(database)
    log = SqliteLog(database.parent)
    assert log.reads.load_cache("reach") is None
    assert restore(log.reads, "reach").model.version == 301
    log.close()
