"""A data directory has one server, and is used only where it holds what crkr made."""

import fcntl
import logging
import os
import shutil
import socket
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from uuid import UUID

import pytest

from crkr.protocol import StorageError, TaskSpec, Trial
from crkr.server.inspection.stored_run import StoredRun
from crkr.server.log import PendingReport, SqliteLog, read_log
from crkr.server.log.sqlite_database import SqliteDatabase

AXIS = {"name": "x", "unit": "m", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "reach", "state": [AXIS], "goal": [AXIS]})
FILES = ("lock", "acknowledged", "crkr.sqlite3", "crkr.sqlite3-wal", "crkr.sqlite3-shm", "crkr.sqlite3-journal")


def pending(number: int) -> list[PendingReport]:
    trial = Trial.create(SPEC, id=UUID(int=number), state=[0.5], goal=[0.5], cost=0.5, success=True, kind="trial")
    return [PendingReport("reach", (trial,))]


@pytest.fixture
def directory(tmp_path: Path) -> Path:
    """A log with a task and three trials, closed in order."""
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    for number in (1, 2, 3):
        log.append_reports(pending(number))
    log.close()
    return tmp_path / "data"


def change(directory: Path, *statements: str) -> None:
    connection = sqlite3.connect(directory / "crkr.sqlite3", isolation_level=None)
    for statement in statements:
        connection.execute(statement)
    connection.close()


def test_a_second_server_is_refused_though_the_lock_file_was_removed(directory: Path) -> None:
    log = SqliteLog(directory)
    (directory / "lock").unlink()
    with pytest.raises(StorageError, match="in use by another process"):
        SqliteLog(directory)
    log.append_reports(pending(4))  # creates the file again
    with pytest.raises(StorageError, match=f"in use by process {os.getpid()}"):
        SqliteLog(directory)
    log.close()
    SqliteLog(directory).close()


def test_a_lock_file_that_is_made_anew_keeps_servers_out_that_know_the_file_only(
    directory: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = SqliteLog(directory)
    (directory / "lock").unlink()
    with caplog.at_level(logging.WARNING):
        log.append_reports(pending(4))
        log.append_reports(pending(5))
    assert [record.getMessage() for record in caplog.records] == [
        f"{directory}/lock was removed while the server runs, and is made again: leave it there"
    ]
    with (directory / "lock").open("rb+") as file, pytest.raises(BlockingIOError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    log.close()


def test_a_server_that_knows_the_lock_file_only_keeps_ours_out(directory: Path) -> None:
    with (directory / "lock").open("rb+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="in use by process"):
            SqliteLog(directory)
    SqliteLog(directory).close()


def test_nothing_is_stored_while_another_server_holds_what_stands_in_the_lock_files_place(directory: Path) -> None:
    log = SqliteLog(directory)
    (directory / "lock").unlink()
    with (directory / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="in use by another process"):
            log.append_reports(pending(4))
    log.append_reports(pending(4))
    assert log.reads.last("reach") == 5
    log.close()


def test_nothing_is_stored_after_another_program_added_to_the_log(directory: Path) -> None:
    log = SqliteLog(directory)
    change(directory, "DELETE FROM trial WHERE seq = 4")
    with pytest.raises(StorageError, match="another program added to or removed from"):
        log.append_reports(pending(4))
    log.close()


def test_a_trigger_that_comes_while_the_server_runs_is_noticed_before_the_next_commit(directory: Path) -> None:
    log = SqliteLog(directory)
    change(directory, "CREATE TRIGGER t AFTER INSERT ON trial BEGIN DELETE FROM trial; END")
    with pytest.raises(StorageError, match="trigger 't'"):
        log.append_reports(pending(4))
    change(directory, "DROP TRIGGER t")
    log.append_reports(pending(4))
    log.close()


def test_a_write_of_another_program_that_leaves_the_entries_alone_stops_nothing(directory: Path) -> None:
    log = SqliteLog(directory)
    change(directory, "DELETE FROM cache", "ANALYZE")
    log.append_reports(pending(4))
    log.close()
    SqliteLog(directory).close()


@pytest.mark.parametrize("name", ["crkr.sqlite3-wal", "crkr.sqlite3-shm"])
@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_nothing_is_stored_in_a_file_that_was_removed_or_replaced(directory: Path, name: str, how: str) -> None:
    log = SqliteLog(directory)
    log.append_reports(pending(4))
    (directory / name).unlink()
    if how == "replaced":
        (directory / name).write_bytes(b"")
    with pytest.raises(StorageError, match=f"{name} was moved, removed or replaced"):
        log.append_reports(pending(5))
    # As a kill would leave it: all that was stored before is in the database.
    copy = directory.with_name("copy")
    copy.mkdir()
    shutil.copy(directory / "crkr.sqlite3", copy)
    assert read_log(copy / "crkr.sqlite3").last("reach") == 5
    log.close()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kind", ["link", "dangling", "fifo", "socket", "directory"])
def test_what_is_no_plain_file_is_refused_and_left_alone(tmp_path: Path, name: str, kind: str) -> None:
    directory, precious = tmp_path / "data", tmp_path / "precious"
    directory.mkdir()
    precious.write_text("precious")
    path = directory / name
    if kind == "link":
        path.symlink_to(precious)
    elif kind == "dangling":
        path.symlink_to(tmp_path / "nowhere")
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            here = os.open(directory, os.O_RDONLY)  # its address has to be short
            bound.bind(f"/proc/self/fd/{here}/{name}")
            os.close(here)
    else:
        path.mkdir()
    said = {"link": "a symbolic link", "dangling": "a symbolic link"}.get(kind, f"a {kind}")
    with pytest.raises(StorageError, match=f"{name} is {said}, not a plain file"):
        SqliteLog(directory)
    assert precious.read_text() == "precious"
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("name", ["acknowledged", "crkr.sqlite3", "crkr.sqlite3-wal"])
def test_reading_refuses_what_is_no_plain_file(directory: Path, name: str) -> None:
    (directory / name).unlink(missing_ok=True)
    os.mkfifo(directory / name)
    with pytest.raises(StorageError, match="is a fifo"):
        StoredRun(directory, "reach")


def test_a_file_of_two_names_is_not_written_over(directory: Path, tmp_path: Path) -> None:
    for name in ("lock", "acknowledged"):
        precious = tmp_path / name
        precious.write_text("precious")
        (directory / name).unlink()
        os.link(precious, directory / name)
    log = SqliteLog(directory)
    log.append_reports(pending(4))
    log.close()
    assert {(tmp_path / name).read_text() for name in ("lock", "acknowledged")} == {"precious"}
    os.link(directory / "crkr.sqlite3", tmp_path / "other.sqlite3")
    with pytest.raises(StorageError, match="has 2 names"):
        SqliteLog(directory)


def test_a_data_directory_may_be_a_symbolic_link(directory: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(directory)
    log = SqliteLog(tmp_path / "link")
    with pytest.raises(StorageError, match="in use"):
        SqliteLog(directory)
    log.close()


def test_a_directory_that_everybody_may_change_is_told(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    directory.chmod(0o777)
    SqliteLog(directory).close()
    assert "may be changed by every user" in caplog.text


def test_a_backup_follows_no_link(directory: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / f"copy.sqlite3.{os.getpid()}.partial").symlink_to(precious)
    reader = SqliteDatabase(directory / "crkr.sqlite3")
    with pytest.raises(OSError, match="File exists"):
        reader.backup(tmp_path / "copy.sqlite3")
    reader.close()
    assert precious.read_text() == "precious"


COLUMNS = "task, seq, id, time, kind, success, cost, state, goal, outcome, worker, model_version, info, digest"
CHANGES = {
    "trigger 't'": ("CREATE TRIGGER t AFTER INSERT ON trial BEGIN DELETE FROM trial; END",),
    "trigger 'u'": ("CREATE TRIGGER u BEFORE UPDATE ON task BEGIN SELECT RAISE(IGNORE); END",),
    "view 'v'": ("CREATE VIEW v AS SELECT 1",),
    "view 'trial'": ("DROP TABLE trial", f"CREATE VIEW trial ({COLUMNS}) AS SELECT {', '.join('1' * 14)}"),
    "view 'cache'": ("DROP TABLE cache", "CREATE VIEW cache AS SELECT 1 AS task"),
    "table 'more'": ("CREATE TABLE more (x)",),
    "table 'found'": ("CREATE VIRTUAL TABLE found USING fts5(x)",),
    "index 'i'": ("CREATE INDEX i ON trial (abs(cost))",),
    "lacks its index 'trial_id'": ("DROP INDEX trial_id",),
    "the index 'trial_id'": ("DROP INDEX trial_id", "CREATE UNIQUE INDEX trial_id ON trial (task, id) WHERE seq > 9"),
    "the table 'trial'": ("ALTER TABLE trial ADD COLUMN twice REAL AS (2 * cost)",),
    "the table 'event'": ("ALTER TABLE event ADD COLUMN more TEXT DEFAULT 'x'",),
    "lacks its table 'event'": ("DROP TABLE event",),
}


@pytest.mark.parametrize("says", CHANGES)
@pytest.mark.parametrize("opened", [SqliteLog, lambda data: read_log(data / "crkr.sqlite3")], ids=["log", "reader"])
def test_other_tables_than_ours_are_refused_before_they_are_read(
    directory: Path, says: str, opened: Callable[[Path], object]
) -> None:
    change(directory, *CHANGES[says])
    before = (directory / "crkr.sqlite3").read_bytes()
    with pytest.raises(StorageError, match=says):
        opened(directory)
    assert (directory / "crkr.sqlite3").read_bytes() == before


def test_a_write_ahead_log_of_another_database_is_refused(directory: Path, tmp_path: Path) -> None:
    other = SqliteLog(tmp_path / "other")
    other.create(SPEC)
    for number in range(1, 50):
        other.append_reports(pending(number))
    shutil.copy(tmp_path / "other" / "crkr.sqlite3-wal", directory / "crkr.sqlite3-wal")
    other.close()
    for opened in (SqliteLog, lambda data: read_log(data / "crkr.sqlite3")):
        with pytest.raises(StorageError, match="belongs to another database"):
            opened(directory)
    (directory / "crkr.sqlite3-wal").unlink()
    log = SqliteLog(directory)
    assert log.reads.last("reach") == 4
    log.close()


def header(pages: int, page_size: int, records: int) -> bytes:
    return bytes.fromhex("d9d505f920a163d7") + struct.pack(">5I", records, 7, pages, 512, page_size) + bytes(484)


def record(number: int, page: bytes) -> bytes:
    checksum = (7 + sum(page[index] for index in range(4096 - 200, 0, -200))) % 2**32
    return struct.pack(">I", number) + page + struct.pack(">I", checksum)


def test_a_rollback_journal_of_another_database_is_refused(directory: Path, tmp_path: Path) -> None:
    other = sqlite3.connect(tmp_path / "other.sqlite3", isolation_level=None)
    other.execute("CREATE TABLE t (x)")
    other.close()
    page = (tmp_path / "other.sqlite3").read_bytes()[:4096]
    before = (directory / "crkr.sqlite3").read_bytes()
    held = len(before) // 4096
    # The first would cut the log, the second would replace its first page, the last any other.
    for left in (header(1, 4096, 0), header(held, 4096, 1) + record(1, page), header(held, 4096, 1) + record(3, page)):
        (directory / "crkr.sqlite3-journal").write_bytes(left)
        with pytest.raises(StorageError, match="belongs to another database"):
            SqliteLog(directory)
        assert (directory / "crkr.sqlite3").read_bytes() == before
    (directory / "crkr.sqlite3-journal").unlink()
    SqliteLog(directory).close()


def test_a_restored_backup_goes_on_after_a_kill_while_it_was_prepared(directory: Path, tmp_path: Path) -> None:
    reader = SqliteDatabase(directory / "crkr.sqlite3")
    (tmp_path / "restored").mkdir()
    restored = tmp_path / "restored" / "crkr.sqlite3"
    reader.backup(restored)
    reader.close()
    content = restored.read_bytes()
    restored.write_bytes(content[:18] + b"\2\2" + content[20:])  # it was to have a write-ahead log
    restored.with_name("crkr.sqlite3-journal").write_bytes(
        header(len(content) // 4096, 4096, 1) + record(1, content[:4096])
    )
    log = SqliteLog(restored.parent)
    assert log.reads.last("reach") == 4
    log.append_reports(pending(4))
    log.close()


def test_a_new_directory_goes_on_after_a_kill_while_it_was_prepared(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "crkr.sqlite3").touch()
    (tmp_path / "data" / "crkr.sqlite3-journal").write_bytes(header(0, 4096, 0))
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    log.close()
