"""Both logs keep what they were given, once and in order."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from logged_trials import SPEC, trial, trials_of

from crkr.protocol import KINDS, Conflict, ShuttingDown, StorageError, pack
from crkr.server.learning.restore import restore
from crkr.server.log import Event, LoggedTrial, PendingReport, SqliteLog, Stored, TaskLog, read_log
from crkr.server.log.access import copy_tasks, copy_to_file, open_unserved


@pytest.fixture
def reopen(place: Path | str) -> Iterator[Callable[[], TaskLog]]:
    """Opens the log, which was closed before; closed at the end of the test."""
    with ExitStack() as stack:

        def opened() -> TaskLog:
            log = open_unserved(str(place))
            stack.callback(log.close)
            return log

        yield opened


@pytest.fixture
def log(reopen: Callable[[], TaskLog]) -> TaskLog:
    log = reopen()
    log.create(SPEC)
    return log


def test_a_trial_comes_back_bit_for_bit(log: TaskLog) -> None:
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


def test_events_and_trials_share_one_numbering(log: TaskLog) -> None:
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


def test_a_page_ends_before_it_grows_too_large(log: TaskLog) -> None:
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
    log: TaskLog, reports: list[list[tuple[int, float]]], cuts: list[int]
) -> None:
    task = f"reach-{len(log.reads.tasks())}"
    log.create(replace(SPEC, name=task))
    known: dict[int, tuple[int, float]] = {}
    expected: list[tuple[int, ...] | None] = []
    for report in reports:
        after = dict(known)
        for number, cost in report:
            after.setdefault(number, (len(after) + 2, cost))
        fits = all(after[number][1] == cost for number, cost in report)
        expected.append(tuple(after[number][0] for number, _ in report) if fits else None)
        known = after if fits else known
    pending = [PendingReport(task, tuple(trial(number, cost) for number, cost in report)) for report in reports]
    found: list[Stored | Conflict | ShuttingDown] = []
    edges = [0, *sorted(min(cut, len(pending)) for cut in cuts), len(pending)]
    for start, stop in pairwise(edges):  # however they are grouped into commits
        found += log.append_reports(pending[start:stop])
    assert [one.seqs if isinstance(one, Stored) else None for one in found] == expected
    assert {entry.trial.id.int: (entry.seq, entry.trial.cost) for entry in trials_of(log, task)} == known


COSTS = st.floats(0.0, 1.0) | st.sampled_from([0.0, -0.0, 1.0, 5e-324])
PLAIN = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=20) | st.binary()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cost=COSTS,
    changed=COSTS,
    worker=st.none() | st.text(min_size=1, max_size=40),
    model_version=st.none() | st.integers(0, 2**62),
    info=st.dictionaries(st.text(max_size=10), PLAIN | st.lists(PLAIN, max_size=3), max_size=3),
)
def test_whatever_was_accepted_is_read_again(
    log: TaskLog,
    cost: float,
    changed: float,
    worker: str | None,
    model_version: int | None,
    info: dict[str, Any],
) -> None:
    task = f"reach-{len(log.reads.tasks())}"
    log.create(replace(SPEC, name=task))
    given = trial(1, cost, worker=worker, model_version=model_version, info=info)
    log.append_reports([PendingReport(task, (given, trial(2)))])
    log.append_event(task, "recost", {"ids": [UUID(int=2)], "costs": [changed]})
    again = read_log(log.where)
    try:
        assert restore(again, task).seq == 4
        [read, _] = [entry for entry in again.read(task) if isinstance(entry, LoggedTrial)]
        assert read.trial.digest() == given.digest()
        assert (read.trial.worker, read.trial.model_version) == (worker, model_version)
        assert pack(read.trial.info) == pack(given.info)
        assert [entry["cost"] for entry in again.page(task, 0, 5, 10**6)[0]] == [cost, changed]
    finally:
        again.close()


def test_tasks_and_their_logs_survive_a_reopening(log: TaskLog, reopen: Callable[[], TaskLog]) -> None:
    log.append_reports([PendingReport("reach", (trial(1),))])
    log.save_cache("reach", 2, b"radii")
    log.close()
    again = reopen()
    assert again.reads.tasks() == ("reach",)
    assert again.reads.load_cache("reach") == (2, b"radii")
    [stored] = again.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    assert isinstance(stored, Stored)
    assert (stored.seqs, len(stored.fresh)) == ((2, 3), 1)


def test_a_reader_beside_the_writer_sees_one_moment(log: TaskLog) -> None:
    reader = read_log(log.where)
    with reader.snapshot():
        assert reader.last("reach") == 1
        log.append_reports([PendingReport("reach", (trial(1),))])
        assert reader.last("reach") == 1
    assert reader.last("reach") == 2
    with pytest.raises(ValueError, match="of the block itself"), reader.snapshot():
        raise ValueError("of the block itself")
    reader.close()


def test_every_kind_of_trial_has_a_place(log: TaskLog) -> None:
    trials = tuple(trial(n, kind=kind) for n, kind in enumerate(KINDS, 1))
    log.append_reports([PendingReport("reach", trials)])
    assert [entry.trial.kind for entry in trials_of(log)] == list(KINDS)


def test_rows_copied_from_log_to_log_are_the_same_bytes(log: TaskLog, tmp_path: Path) -> None:
    log.append_reports(
        [PendingReport("reach", (trial(1, worker="a\0b", info={"a": 1}), trial(2, cost=None, kind="failed")))]
    )
    log.append_event("reach", "recost", {"ids": [UUID(int=1)], "costs": [0.25], "reason": ""})
    log.append_event("reach", "remove", {"ids": [UUID(int=1)], "reason": ""})
    copy = SqliteLog(tmp_path / "copy")
    try:
        assert copy_tasks(log.reads, copy) == ("reach",)
        assert [list(rows) for rows in copy.reads.raw("reach")] == [list(rows) for rows in log.reads.raw("reach")]
        with pytest.raises(Conflict, match="holds a task 'reach' already"):
            copy_tasks(log.reads, copy)
        copy.append_reports([PendingReport("reach", (trial(3),))])
        assert copy.reads.last("reach") == log.reads.last("reach") + 1
    finally:
        copy.close()


def test_a_copy_in_a_file_is_whole_and_takes_no_file_s_place(log: TaskLog, tmp_path: Path) -> None:
    log.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    target = tmp_path / "backups" / "monday.sqlite3"
    with pytest.raises(StorageError, match=r"cannot back up to .*: No such file or directory"):
        copy_to_file(log.reads, target)
    target.parent.mkdir()
    copy_to_file(log.reads, target)
    log.append_reports([PendingReport("reach", (trial(3),))])
    with pytest.raises(StorageError, match="exists; choose another file"):
        copy_to_file(log.reads, target)
    with closing(read_log(target)) as copy:
        assert copy.positions() == {"reach": 3}
    assert list(target.parent.iterdir()) == [target]


def test_a_task_takes_another_name_is_deleted_and_purged(log: TaskLog, reopen: Callable[[], TaskLog]) -> None:
    log.append_reports([PendingReport("reach", (trial(1), trial(2)))])
    log.append_event("reach", "rename", {"name": "grasp"})
    log.append_reports([PendingReport("grasp", (trial(3),))])
    assert log.reads.positions() == {"grasp": 5}
    log.append_event("grasp", "delete", {"name": "deleted/grasp/1"})
    log.create(SPEC)
    assert log.reads.positions() == {"deleted/grasp/1": 6, "reach": 1}
    assert log.purge() == ["deleted/grasp/1"]
    log.append_reports([PendingReport("reach", (trial(1),))])
    log.close()
    again = reopen()
    assert again.reads.positions() == {"reach": 2}
    assert again.reads.integrity() == []
