"""The database dies, comes back, is cut off, or refuses a server: predictions go on, and no report is lost."""

import signal
import threading
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
from postgres import TcpLink

from crkr.client import Task
from crkr.protocol import StorageError, Unavailable
from crkr.server.follower import Follower
from crkr.server.log import LoggedTrial, read_log
from crkr.server.log.postgres.url import printable_location

BEAT = "SELECT min(beat) FROM crkr.server"


def stored_once(url: str, acknowledged: list[Any]) -> bool:
    """Whether every acknowledged trial is there once, in a log without a gap."""
    with closing(read_log(url)) as reader:
        entries = list(reader.read("reach"))
    stored = [entry.trial.id for entry in entries if isinstance(entry, LoggedTrial)]
    gapless = [entry.seq for entry in entries] == list(range(1, len(entries) + 1))
    return gapless and len(stored) == len(set(stored)) and set(acknowledged) <= set(stored)


@pytest.mark.parametrize(
    "how", [signal.SIGQUIT, pytest.param(signal.SIGINT, marks=pytest.mark.campaign)], ids=["crash", "restart"]
)
def test_predictions_go_on_without_the_database_and_reports_wait_for_it(
    how: signal.Signals, pair: Any, reporters: Any, task: Task, postgres: Any, processes: Any
) -> None:
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 30)
    postgres.stop(how)
    try:
        assert task.predict([0.1, 0.2]).model_version > 1
        with pytest.raises(Unavailable, match=r"SHUTTING_DOWN: .* the database is away"):
            task.report(state=[0.1, 0.2], goal=[0.1, 0.2], cost=0.5, success=True, timeout_s=2.0)
        assert task.predict([0.1, 0.2]).model_version > 1
    finally:
        postgres.start()
    reached = len(reporters.acknowledged)
    processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 30)
    reporters.end()
    assert reporters.failed == []
    assert stored_once(pair.url, reporters.acknowledged)
    assert [member.process.poll() for member in pair.members] == [None, None]


def test_a_server_that_is_cut_off_from_the_database_leaves_its_clients_to_the_other(
    postgres: Any, make_pair: Callable[..., Any], start_reporters: Callable[..., Any], processes: Any
) -> None:
    with TcpLink(postgres.port) as link:
        pair = make_pair(link.port)
        first, second = pair.members
        reporters = start_reporters(pair)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 30)
        database = pair.url.rpartition("/")[2]
        [(beat,)] = postgres.execute(database, BEAT)
        processes.wait_until(lambda: postgres.execute(database, BEAT)[0][0] > beat + 1)  # it knows who stands by
        link.cut()
        processes.wait_until(lambda: second.says("listening on"), second.log)
        processes.wait_until(lambda: first.says("another server answers at"), first.log)
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 30)
        link.mend()
        processes.wait_until(lambda: first.says("standing by"), first.log)
        reporters.end()
        assert reporters.failed == []
        assert stored_once(pair.url, reporters.acknowledged)


def test_a_server_that_the_database_refuses_is_told_why_without_the_password(
    postgres: Any, make_database: Callable[[], str]
) -> None:
    database = make_database().rpartition("/")[2]
    postgres.execute(database, "DROP ROLE IF EXISTS guarded")
    postgres.execute(database, "CREATE ROLE guarded LOGIN PASSWORD 'right'")
    for user, says in (("guarded:wrong", "password authentication failed"), ("nobody-there", "does not exist")):
        with pytest.raises(StorageError, match=says) as caught:
            Follower(postgres.url(database, user), "tcp/127.0.0.1:1", lambda _: None).take()
        assert "wrong" not in caught.value.message
        assert "\n" not in caught.value.message
    postgres.execute(database, "DROP ROLE guarded")


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("postgresql://u:word@h:5432/db", "postgresql://u@h:5432/db"),
        ("postgresql://u:p@ss@h/db", "postgresql://u@h/db"),
        ("postgresql://u:pa/ss@h/db", "postgresql://u@h/db"),
        ("postgresql://h:5432/db?password=p@ss&user=u", "postgresql://h:5432/db?password=...&user=u"),
        ("postgresql://u@h:5432,k:5433/db", "postgresql://u@h:5432,k:5433/db"),
    ],
)
def test_a_location_is_shown_without_its_password(url: str, shown: str) -> None:
    assert printable_location(url) == shown


def test_a_server_waits_for_a_database_that_is_away(
    postgres: Any, make_database: Callable[[], str], processes: Any
) -> None:
    url = make_database()
    said: list[str] = []
    taken: list[Any] = []
    taking = threading.Thread(target=lambda: taken.append(Follower(url, "tcp/127.0.0.1:1", said.append).take()))
    postgres.stop(signal.SIGQUIT)
    try:
        taking.start()
        processes.wait_until(lambda: said)
        assert said[0].startswith("waiting for the database: cannot open the task log: the database is away")
    finally:
        postgres.start()
    taking.join(60)
    [(log, tasks)] = taken
    assert tasks == []
    log.close()
