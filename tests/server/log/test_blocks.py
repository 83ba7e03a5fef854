"""A log read as columns is the log read trial by trial, and damage is noticed either way."""

import sqlite3
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest

from crkr.learner import TrialColumns
from crkr.protocol import KINDS, StorageError, TaskSpec, Trial
from crkr.server.learning.radii_cache import save_radii
from crkr.server.learning.restore import restore
from crkr.server.log import Event, LoggedTrial, PendingReport, SqliteLog

AXIS = {"name": "x", "unit": "m", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict(
    {
        "name": "reach",
        "state": [AXIS],
        "goal": [AXIS, {**AXIS, "name": "y"}],
        "outcome": [{"name": "miss", "unit": "m", "tolerance": 0.1}],
        "exploration": {"type": "outcome", "gate": 0},
        "budget": 40,
    }
)
MANY = 9000


def trial(number: int, rng: np.random.Generator) -> Trial:
    kind = KINDS[int(rng.choice(4, p=[0.7, 0.1, 0.1, 0.1]))]
    return Trial.create(
        SPEC,
        id=UUID(int=number),
        state=rng.uniform(-1, 1, 1),
        goal=rng.uniform(-1, 1, 2),
        cost=None if kind == "failed" else float(rng.uniform()),
        success=kind != "failed" and bool(rng.integers(2)),
        kind=kind,
        outcome=[float("nan")] if number % 3 == 0 else [0.5] if number % 3 == 1 else None,
        learn=bool(number % 2) if kind == "trial" and number % 5 == 0 else None,
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A long log with events between its trials."""
    directory = tmp_path_factory.mktemp("log")
    rng = np.random.default_rng(3)
    log = SqliteLog(directory)
    log.create(SPEC)
    for first in range(1, MANY, 1000):
        log.append_reports([PendingReport("reach", tuple(trial(n, rng) for n in range(first, first + 1000)))])
        log.append_event("reach", "recost", {"ids": [UUID(int=first)], "costs": [0.5], "reason": ""})
        log.append_event("reach", "remove", {"ids": [UUID(int=first + 1)], "reason": ""})
    log.close()
    return directory / "crkr.sqlite3"


@pytest.fixture
def database(written: Path, tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    copy = tmp_path / "data" / "crkr.sqlite3"
    copy.write_bytes(written.read_bytes())
    return copy


def columns(trials: list[LoggedTrial]) -> list[tuple[object, ...]]:
    return [
        (one.seq, one.trial.id.bytes, one.trial.digest(), one.trial.state.tobytes(), one.trial.goal.tobytes())
        for one in trials
    ]


@pytest.mark.parametrize("upto", [1, 500, 1002, 1003, MANY + 19, 10**6])
def test_blocks_hold_what_reading_gives(database: Path, upto: int) -> None:
    log = SqliteLog(database.parent)
    entries = [entry for entry in log.reads.read("reach") if entry.seq <= upto]
    blocks = list(log.reads.blocks("reach", 1, 2, 1, upto))
    log.close()
    trials = [entry for entry in entries if isinstance(entry, LoggedTrial)]
    found = [block for block in blocks if isinstance(block, TrialColumns)]
    assert [one.seq for one in blocks if isinstance(one, Event)] == [e.seq for e in entries if isinstance(e, Event)]
    rows = [
        (
            int(block.seqs[row]),
            block.ids[16 * row : 16 * row + 16],
            block.digests[16 * row : 16 * row + 16],
            block.states[row].tobytes(),
            block.goals[row].tobytes(),
        )
        for block in found
        for row in range(len(block))
    ]
    assert rows == columns(trials)
    costs = [np.nan if one.trial.cost is None else one.trial.cost for one in trials]
    np.testing.assert_array_equal(np.concatenate([[], *(block.costs for block in found)]), costs)
    outcomes = [np.full(1, np.nan) if one.trial.outcome is None else one.trial.outcome for one in trials]
    read = [block.outcomes for block in found if block.outcomes is not None]
    np.testing.assert_array_equal(np.concatenate([np.empty((0, 1)), *read]), np.reshape(outcomes, (-1, 1)))
    kinds = [KINDS[kind] for block in found for kind in block.kinds]
    assert kinds == [one.trial.kind for one in trials]
    assert [int(flags) for block in found for flags in block.flags] == [one.trial.flags for one in trials]


def test_a_restart_from_kept_radii_and_one_without_give_the_same_task(database: Path) -> None:
    log = SqliteLog(database.parent)
    first = restore(log.reads, "reach")
    radii = first.learner.radii()
    assert radii is not None
    save_radii(log, "reach", radii)
    log.append_reports([PendingReport("reach", (trial(10**6, np.random.default_rng(5)),))])
    second = restore(log.reads, "reach")
    log.save_cache("reach", 1, b"")  # useless: all is computed again
    third = restore(log.reads, "reach")
    log.close()
    assert second.seq == first.seq + 1
    assert second.learner.active_ids == third.learner.active_ids
    assert (second.samples, second.eligible, second.seq) == (third.samples, third.eligible, third.seq)
    state = np.linspace(-1, 1, 7)[:, None]
    for explore in (False, True):
        ids = [UUID(int=number) for number in range(7)]
        ours, theirs = (task.model.predict(state, explore, ids) for task in (second, third))
        np.testing.assert_allclose(ours.means, theirs.means, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.goals, theirs.goals, rtol=0, atol=1e-9)
        assert ours.policy == theirs.policy == ("explore" if explore else "corrected")


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("UPDATE trial SET state = x'0000000000000000' WHERE seq = 4000", "position 4000 does not match"),
        ("UPDATE trial SET cost = 0.123 WHERE seq = 4001", "position 4001 does not match"),
        ("UPDATE trial SET success = success + 1 - 2 * (success & 1) WHERE seq = 4002", "position 4002 does not match"),
        ("UPDATE trial SET digest = x'00' WHERE seq = 4002", "position 4002 does not match"),
        ("UPDATE trial SET kind = 9 WHERE seq = 4003", "damaged"),
        ("UPDATE trial SET id = x'00' WHERE seq = 4003", "damaged"),
        ("UPDATE trial SET goal = 'text' WHERE seq = 4003", "damaged"),
        ("DELETE FROM trial WHERE seq = 4100", "lacks position 4100"),
        ("DELETE FROM trial WHERE seq = 2", "lacks position 2"),
        ("DELETE FROM event WHERE seq = 1002", "lacks position 1002"),
    ],
)
def test_damage_is_refused(database: Path, statement: str, says: str) -> None:
    with sqlite3.connect(database) as connection:
        connection.execute(statement)
    connection.close()
    log = SqliteLog(database.parent)

    with pytest.raises(StorageError, match=says):
        restore(log.reads, "reach")
    log.close()
