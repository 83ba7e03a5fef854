"""The log keeps what it was given, once and in order, and notices when somebody else changed it."""

import sqlite3
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from crkr.protocol import KINDS, Conflict, StorageError, TaskSpec, Trial, pack
from crkr.server.learning.restore import restore, restore_all
from crkr.server.log import Event, LoggedTrial, PendingReport, SqliteLog, SqliteReader, Stored

AXIS = {"name": "x", "unit": "m", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "reach", "state": [AXIS], "goal": [AXIS, {**AXIS, "name": "y"}]})


def trial(number: int, cost: float | None = 0.5, kind: str = "trial", **changes: Any) -> Trial:
    rng = np.random.default_rng(number)
    return Trial.create(
        SPEC,
        id=UUID(int=number),
        state=rng.uniform(-1, 1, 1),
        goal=rng.uniform(-1, 1, 2),
        cost=cost,
        success=kind != "failed",
        kind=kind,
        **changes,
    )


@pytest.fixture
def log(tmp_path: Path) -> Iterator[SqliteLog]:
    log = SqliteLog(tmp_path / "data")
    log.create(SPEC)
    yield log
    log.close()


def trials_of(log: SqliteLog) -> list[LoggedTrial]:
    return [entry for entry in log.reads.read("reach") if isinstance(entry, LoggedTrial)]


def test_a_trial_comes_back_bit_for_bit(log: SqliteLog) -> None:
    given = trial(1, worker="ada", model_version=3, info={"reason": "hit", "nested": [1, {"a": b"b"}]})
    bare, lucky = trial(2, cost=None, kind="failed"), trial(3, learn=False)
    [stored] = log.append_reports([PendingReport("reach", (given, bare, lucky))])
    assert isinstance(stored, Stored)
    assert stored.seqs == (2, 3, 4)
    first, second, third = trials_of(log)
    for read, reported in ((first.trial, given), (second.trial, bare), (third.trial, lucky)):
        assert read.digest() == reported.digest()
        assert (read.success, read.learn) == (reported.success, reported.learn)
        assert (read.id, read.worker, read.model_version, read.info) == (
            reported.id,
            reported.worker,
            reported.model_version,
            reported.info,
        )
    assert second.trial.cost is None


def test_events_and_trials_share_one_numbering(log: SqliteLog) -> None:
    log.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    log.append_event("reach", "recost", {"ids": [UUID(int=1)], "costs": [0.25], "reason": "why not"})
    log.append_reports([PendingReport("reach", (trial(3),))])
    log.append_event("reach", "remove", {"ids": [UUID(int=2)], "reason": ""})
    entries = list(log.reads.read("reach"))
    assert [entry.seq for entry in entries] == [1, 2, 3, 4, 5, 6]
    assert [entry.kind for entry in entries if isinstance(entry, Event)] == ["create", "recost", "remove"]
    assert [entry.seq for entry in log.reads.read("reach", after=3)] == [4, 5, 6]
    page, following = log.reads.page("reach", 0, 10, 10**6)
    assert [(one["seq"], one["cost"], one.get("removed", False)) for one in page] == [
        (2, 0.25, False),
        (3, 0.5, True),
        (5, 0.5, False),
    ]
    assert following is None
    assert trials_of(log)[0].trial.cost == 0.5  # what was reported stays; the recost is an event of its own


def test_a_page_ends_before_it_grows_too_large(log: SqliteLog) -> None:
    log.append_reports([PendingReport("reach", tuple(trial(n, info={"text": "x" * 5000}) for n in range(10)))])
    page, following = log.reads.page("reach", 0, 100, 20_000)
    assert len(page) == 3
    assert following == page[-1]["seq"]
    assert len(log.reads.page("reach", 0, 100, 1)[0]) == 1  # never empty, or nobody would get on


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    reports=st.lists(
        st.lists(st.tuples(st.integers(1, 12), st.sampled_from([0.1, 0.2])), min_size=1, max_size=5), max_size=8
    ),
    cuts=st.lists(st.integers(0, 8), max_size=3),
)
def test_any_sequence_of_reports_is_stored_as_a_dictionary_would(
    tmp_path_factory: pytest.TempPathFactory, reports: list[list[tuple[int, float]]], cuts: list[int]
) -> None:
    log = SqliteLog(tmp_path_factory.mktemp("log"))
    log.create(SPEC)
    known: dict[int, tuple[int, float]] = {}
    expected: list[tuple[int, ...] | None] = []
    for report in reports:
        after = dict(known)
        for number, cost in report:
            after.setdefault(number, (len(after) + 2, cost))
        fits = all(after[number][1] == cost for number, cost in report)
        expected.append(tuple(after[number][0] for number, _ in report) if fits else None)
        known = after if fits else known
    pending = [PendingReport("reach", tuple(trial(number, cost) for number, cost in report)) for report in reports]
    found: list[Stored | Conflict] = []
    edges = [0, *sorted(min(cut, len(pending)) for cut in cuts), len(pending)]
    for start, stop in pairwise(edges):  # however they are grouped into commits
        found += log.append_reports(pending[start:stop])
    assert [one.seqs if isinstance(one, Stored) else None for one in found] == expected
    assert {entry.trial.id.int: (entry.seq, entry.trial.cost) for entry in trials_of(log)} == known
    log.close()


COSTS = st.floats(0.0, 1.0) | st.sampled_from([0.0, -0.0, 1.0, 5e-324])
PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20) | st.binary()


@settings(max_examples=60, deadline=None)
@given(
    cost=COSTS,
    changed=COSTS,
    worker=st.none() | st.text(min_size=1, max_size=40),
    model_version=st.none() | st.integers(0, 2**62),
    info=st.dictionaries(st.text(max_size=10), PLAIN | st.lists(PLAIN, max_size=3), max_size=3),
)
def test_whatever_was_accepted_is_read_again(
    tmp_path_factory: pytest.TempPathFactory,
    cost: float,
    changed: float,
    worker: str | None,
    model_version: int | None,
    info: dict[str, Any],
) -> None:
    directory = tmp_path_factory.mktemp("log")
    log = SqliteLog(directory)
    log.create(SPEC)
    given = trial(1, cost, worker=worker, model_version=model_version, info=info)
    log.append_reports([PendingReport("reach", (given, trial(2)))])
    log.append_event("reach", "recost", {"ids": [UUID(int=2)], "costs": [changed]})
    log.close()
    log = SqliteLog(directory)
    restore_all(log.reads, log.path)
    [read, _] = trials_of(log)
    assert read.trial.digest() == given.digest()
    assert (read.trial.worker, read.trial.model_version) == (worker, model_version)
    assert pack(read.trial.info) == pack(given.info)
    assert [entry["cost"] for entry in log.reads.page("reach", 0, 5, 10**6)[0]] == [cost, changed]
    log.close()


def test_tasks_and_their_logs_survive_a_reopening(log: SqliteLog, tmp_path: Path) -> None:
    log.append_reports([PendingReport("reach", (trial(1),))])
    log.save_cache("reach", 2, b"radii")
    log.close()
    again = SqliteLog(tmp_path / "data")
    assert again.reads.tasks() == ("reach",)
    assert again.reads.load_cache("reach") == (2, b"radii")
    [stored] = again.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    assert isinstance(stored, Stored)
    assert (stored.seqs, len(stored.fresh)) == ((2, 3), 1)
    again.close()


def test_one_process_holds_a_directory(log: SqliteLog, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="in use by process"):
        SqliteLog(tmp_path / "data")


def test_a_reader_beside_the_writer_sees_one_moment(log: SqliteLog) -> None:
    reader = SqliteReader(log.path)
    with reader.snapshot():
        assert reader.last("reach") == 1
        log.append_reports([PendingReport("reach", (trial(1),))])
        assert reader.last("reach") == 1
    assert reader.last("reach") == 2
    reader.close()


def test_a_backup_is_a_whole_log_of_its_own(log: SqliteLog, tmp_path: Path) -> None:
    log.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    (tmp_path / "restored").mkdir()
    target = tmp_path / "restored" / "crkr.sqlite3"
    log.reads.backup(target)
    log.append_reports([PendingReport("reach", (trial(3),))])
    with pytest.raises(StorageError, match="exists"):
        log.reads.backup(target)
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
            restore_all(log.reads, log.path)
        finally:
            log.close()

    with pytest.raises(StorageError, match=says):
        start()
    assert database.read_bytes() == before


def test_a_log_of_the_first_schema_is_read_and_goes_on_in_the_present_one(database: Path) -> None:
    before = SqliteReader(database)
    trials = [entry.trial.digest() for entry in before.read("reach") if isinstance(entry, LoggedTrial)]
    before.close()
    changed("UPDATE trial SET digest = substr(digest, 1, 16)")(database)
    changed("PRAGMA user_version = 1")(database)
    (database.parent / "acknowledged").unlink()
    log = SqliteLog(database.parent)
    restore_all(log.reads, log.path)
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


def test_every_kind_of_trial_has_a_place(log: SqliteLog) -> None:
    trials = tuple(trial(n, kind=kind) for n, kind in enumerate(KINDS, 1))
    log.append_reports([PendingReport("reach", trials)])
    assert [entry.trial.kind for entry in trials_of(log)] == list(KINDS)
