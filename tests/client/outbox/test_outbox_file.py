"""The file of an outbox keeps what it was given, for one process, and leaves files alone that are none."""

import os
import re
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from hashlib import blake2b
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import Conflict, Invalid, StorageError, TaskSpec, Trial, Unavailable, make_trials, pack

SPEC = TaskSpec.from_dict(
    {"name": "lob", "state": [{"name": "x", "low": 0, "high": 1}], "goal": [{"name": "g", "low": -1, "high": 1}]}
)


def trials(count: int) -> tuple[Trial, ...]:
    return make_trials(SPEC, state=np.zeros((count, 1)), goal=np.zeros((count, 1)), cost=0.5, success=True)


def numbers(file: OutboxFile) -> list[int]:
    return [number for number, _ in file.next(1000)]


@pytest.mark.parametrize("content", [b"not a database at all" * 100, "rollback", "wal"])
def test_a_file_that_is_no_outbox_is_refused_and_left_as_it_is(tmp_path: Path, content: bytes | str) -> None:
    path = tmp_path / "box"
    if isinstance(content, str):
        database = sqlite3.connect(path)
        database.execute(f"PRAGMA journal_mode = {'DELETE' if content == 'rollback' else 'WAL'}")
        database.execute("CREATE TABLE theirs (x)")
        database.close()
    else:
        path.write_bytes(content)
    before = path.read_bytes()
    with pytest.raises(StorageError, match=re.escape(str(path))):
        OutboxFile(path, "lob")
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["box"]


@pytest.mark.parametrize(
    "change",
    [
        "CREATE TRIGGER undo AFTER INSERT ON trial BEGIN DELETE FROM trial; END",
        "CREATE TABLE theirs (x)",
        "ALTER TABLE trial RENAME TO hidden; CREATE VIEW trial AS SELECT * FROM hidden",
    ],
)
def test_an_outbox_that_others_changed_is_refused_and_left_as_it_is(tmp_path: Path, change: str) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "lob")
    file.describe(SPEC)
    file.close()
    with closing(sqlite3.connect(path)) as database:
        database.executescript(change)
    before = path.read_bytes()
    with pytest.raises(StorageError, match="is no outbox"):
        OutboxFile(path, "lob")
    assert path.read_bytes() == before


def test_an_outbox_whose_task_cannot_be_one_is_none(tmp_path: Path) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "x" * 100_000)
    file.describe(SPEC)
    file.close()
    with pytest.raises(StorageError) as refusal:
        OutboxFile.existing(path)
    assert len(refusal.value.message) < 1000


def test_an_empty_file_is_a_new_one(tmp_path: Path) -> None:
    path = tmp_path / "box"
    path.touch()
    OutboxFile(path, "lob").close()
    OutboxFile(path, "lob").close()


def test_it_keeps_the_specification_and_belongs_to_its_task(tmp_path: Path) -> None:
    file = OutboxFile(tmp_path / "box", "lob")
    assert file.spec is None
    assert file.describe(SPEC) == SPEC
    file.close()
    again = OutboxFile(tmp_path / "box", "lob")
    assert again.spec == SPEC
    again.close()
    with pytest.raises(Conflict, match="'lob'"):
        OutboxFile(tmp_path / "box", "smash")


@pytest.mark.parametrize("name", [":memory:", "file:box?mode=memory", "box"])
def test_a_name_is_a_file_where_the_program_was_when_it_opened_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    file = OutboxFile(Path(name), "lob")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    file.add(trials(2))
    file.close()
    assert os.listdir(".") == []
    again = OutboxFile(tmp_path / name, "lob")
    assert again.pending() == 2
    again.close()


@pytest.mark.parametrize("how", ["removed", "moved", "replaced"])
def test_what_would_be_written_to_a_file_that_is_gone_is_refused(tmp_path: Path, how: str) -> None:
    path, aside = tmp_path / "box", tmp_path / "aside"
    file = OutboxFile(path, "lob")
    file.add(trials(3))
    if how == "removed":
        path.unlink()
    else:
        path.rename(aside)
    if how == "replaced":
        path.write_bytes(b"another")
    with pytest.raises(StorageError, match="moved, removed or replaced"):
        file.add(trials(1))
    if how == "moved":
        aside.rename(path)
        file.add(trials(1))
        assert file.pending() == 4
    file.close()


def test_what_an_interrupt_left_half_done_is_undone_before_the_next(tmp_path: Path) -> None:
    file = OutboxFile(tmp_path / "box", "lob")
    file.add(trials(3))

    class Interrupted(list[int]):
        def __iter__(self) -> Iterator[int]:
            yield from (1, 2)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        file.delivered(Interrupted())
    assert numbers(file) == [1, 2, 3]
    file.add(trials(1))
    assert file.pending() == 4
    file.close()


def test_a_closed_one_says_so(tmp_path: Path) -> None:
    file = OutboxFile(tmp_path / "box", "lob")
    file.close()
    file.close()
    calls: list[Any] = [file.pending, file.refused, lambda: file.next(1), lambda: file.add(trials(1))]
    for call in calls:
        with pytest.raises(Unavailable, match="is closed; open it again"):
            call()


def test_only_what_was_put_aside_can_be_discarded(tmp_path: Path) -> None:
    file = OutboxFile(tmp_path / "box", "lob")
    file.add(trials(4))
    file.refuse(2, "INVALID: no")
    file.discard([1, 2, 3])
    assert (numbers(file), file.refused(), file.pending()) == ([1, 3, 4], [], 3)
    file.close()


@pytest.mark.parametrize("what", ["body = x'00'", "digest = x'00'", "body = 'text'", "body = 7", "digest = NULL"])
def test_a_damaged_trial_is_told_from_the_others(tmp_path: Path, what: str) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "lob")
    given = trials(3)
    file.add(given)
    file.close()
    with sqlite3.connect(path) as database:
        if "NULL" in what:
            database.execute("PRAGMA writable_schema = ON")
            database.execute("UPDATE sqlite_master SET sql = replace(sql, 'digest BLOB NOT NULL', 'digest BLOB')")
    database.close()
    with sqlite3.connect(path) as database:
        database.execute(f"UPDATE trial SET {what} WHERE number = 2")
    database.close()
    file = OutboxFile(path, "lob")
    rows = file.next(10)
    assert [trial and trial["id"] for _, trial in rows] == [given[0].id.bytes, None, given[2].id.bytes]
    file.refuse(2, "STORAGE: damaged")
    [refused] = file.refused()
    assert (refused.number, refused.id, refused.trial) == (2, None, {})
    file.close()


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else 1


@pytest.mark.parametrize(
    "info",
    [
        {"torque": {0: 1.2, 1: 0.3}},
        {"torque": {None: 1}},
        {"torque": {(1, 2): 1}},
        {"deep": nested(70)},
    ],
)
def test_what_would_not_be_read_back_is_refused_and_nothing_is_kept(tmp_path: Path, info: dict[str, Any]) -> None:
    file = OutboxFile(tmp_path / "box", "lob")
    file.describe(SPEC)
    with pytest.raises(Invalid, match="info"):
        file.add((*trials(2), *made(info)))
    assert file.pending() == 0
    file.close()


def made(info: dict[str, Any]) -> tuple[Trial, ...]:
    return make_trials(SPEC, state=np.zeros((1, 1)), goal=np.zeros((1, 1)), cost=0.5, success=True, info=info)


def unchecked(path: Path, body: bytes) -> None:
    """Adds a row as the version before did, which checked no more than that it can be packed."""
    with sqlite3.connect(path) as database:
        digest = blake2b(body, digest_size=16).digest()
        database.execute("INSERT INTO trial (body, digest) VALUES (?, ?)", (body, digest))
    database.close()


def test_an_unreadable_row_of_an_earlier_version_is_told_from_the_others(tmp_path: Path) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "lob")
    file.describe(SPEC)
    first, second = trials(2)
    file.add([first])
    file.close()
    message = {**second.to_wire(), "id": second.id.bytes, "state": [0.0], "goal": [0.0], "info": {"torque": {0: 1.5}}}
    unchecked(path, msgpack.packb(message))
    unchecked(path, b"\x93")
    file = OutboxFile(path, "lob")
    assert [trial is None for _, trial in file.next(10)] == [False, True, True]
    assert "text keys" in file.why_unreadable(2)
    for number in (2, 3):
        file.refuse(number, f"STORAGE: {file.why_unreadable(number)}")
    told = file.refused()
    assert [(one.id, one.trial.get("info")) for one in told] == [(second.id, {"torque": {0: 1.5}}), (None, None)]
    file.discard([2, 3])
    assert (numbers(file), file.refused()) == ([1], [])
    file.close()


def test_a_specification_with_settings_that_are_refused_today_still_opens(tmp_path: Path) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "lob")
    file.describe(SPEC)
    file.close()
    with sqlite3.connect(path) as database:
        database.execute("UPDATE about SET spec = ?", (pack({**SPEC.to_dict(), "budget": -1}),))
    database.close()
    file = OutboxFile(path, "lob")
    assert file.spec is not None
    assert (file.spec.state, file.spec.goal) == (SPEC.state, SPEC.goal)
    file.close()


def test_damaged_text_in_the_file_is_told_and_stops_nothing(tmp_path: Path) -> None:
    path = tmp_path / "box"
    file = OutboxFile(path, "lob")
    file.add(trials(3))
    file.refuse(1, "INVALID: no")
    file.close()
    with sqlite3.connect(path) as database:
        database.execute("UPDATE trial SET error = CAST(x'ff41' AS TEXT) WHERE number = 1")
        database.execute("UPDATE trial SET body = CAST(x'ff41' AS TEXT) WHERE number = 2")
    database.close()
    file = OutboxFile(path, "lob")
    assert [trial is None for _, trial in file.next(10)] == [True, False]
    assert [one.error[-1] for one in file.refused()] == ["A"]
    file.close()


FORKED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import CrkrError, TaskSpec, make_trials, unpack

spec = TaskSpec.from_dict(unpack(bytes.fromhex(sys.argv[2])))
file = OutboxFile(Path(sys.argv[1]), "lob")

def put(count):
    file.add(make_trials(spec, state=np.zeros((count, 1)), goal=np.zeros((count, 1)), cost=0.5, success=True))

put(20)
child = os.fork()
if child == 0:
    for call in (lambda: put(1), file.pending, lambda: OutboxFile(Path(sys.argv[1] + "2"), "lob")):
        try:
            call()
        except CrkrError as error:
            print("spawn" in error.message, flush=True)
    file.close()
    del file
    sys.exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
put(20)
print(file.pending(), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_forked_child_leaves_the_parents_file_alone(tmp_path: Path) -> None:
    """SQLite would end the child's copy of the connection by removing the journal that the parent goes on writing."""
    command = [sys.executable, "-c", FORKED, str(tmp_path / "box"), pack(SPEC.to_dict()).hex()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.stdout.splitlines() == ["True", "True", "True", "7", "40"], done.stderr
    file = OutboxFile(tmp_path / "box", "lob")
    assert file.pending() == 40
    file.close()
