"""The database dies, comes back, is cut off, or refuses a server: predictions go on, and no report is lost."""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

import pytest
from postgres import Postgres, TcpLink, running_postgres
from processes import Processes

from crkr.client import Task
from crkr.protocol import ShuttingDown, StorageError, Unavailable
from crkr.server.follower import Follower
from crkr.server.log import LoggedTrial, read_log
from crkr.server.log.postgres.url import printable_location

from .test_log_owners import SPEC, Owner, report

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
    how: signal.Signals, pair: Any, reporters: Any, task: Task, postgres: Postgres, processes: Processes
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


@pytest.mark.parametrize("silently", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_a_server_that_is_cut_off_from_the_database_leaves_its_clients_to_the_other(
    silently: bool,
    postgres: Postgres,
    make_pair: Callable[..., Any],
    start_reporters: Callable[..., Any],
    processes: Processes,
) -> None:
    with TcpLink(postgres.port) as link:
        pair = make_pair(link.port)
        first, second = pair.members
        reporters = start_reporters(pair)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 30)
        database = pair.url.rpartition("/")[2]
        [(beat,)] = postgres.execute(database, BEAT)
        processes.wait_until(lambda: postgres.execute(database, BEAT)[0][0] > beat + 1)  # it knows who stands by
        if silently:
            link.fall_silent()
        else:
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


def test_a_database_that_stands_still_counts_as_away_until_it_goes_on(
    make_database: Callable[[], str], processes: Processes
) -> None:
    with running_postgres() as cluster:
        url = cluster.create("still")
        owner, _ = Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()
        lost: list[str] = []
        owner.keep(lost.append)
        owner.create(SPEC)
        assert cluster.process is not None
        everything = [cluster.process.pid, *processes.children(cluster.process.pid)]
        for pid in everything:
            os.kill(pid, signal.SIGSTOP)
        try:
            with pytest.raises(ShuttingDown, match=r"the database is away .*wait timeout expired"):
                owner.append_reports(report(1))
        finally:
            for pid in reversed(everything):
                os.kill(pid, signal.SIGCONT)
        with pytest.raises(ShuttingDown, match="the database is away"):
            owner.append_reports(report(1))

        def store() -> bool:
            with suppress(ShuttingDown):
                recovered = owner.recover()
                owner.append_reports(report(1))
                return len(recovered) in (0, 1)
            return False

        processes.wait_until(store)
        assert [entry.seq for entry in owner.reads.read("reach")] == [1, 2]
        assert lost == []
        owner.close()


def test_a_slow_database_slows_reports_and_nothing_else(
    postgres: Postgres, make_pair: Callable[..., Any], start_reporters: Callable[..., Any], processes: Processes
) -> None:
    with TcpLink(postgres.port) as link:
        pair = make_pair(link.port)
        first, second = pair.members
        reporters = start_reporters(pair)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > 30)
        link.slow_down(0.03)
        reached, database = len(reporters.acknowledged), pair.url.rpartition("/")[2]
        [(beat,)] = postgres.execute(database, BEAT)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 20)
        processes.wait_until(lambda: postgres.execute(database, BEAT)[0][0] > beat + 3)
        reporters.end()
        assert reporters.failed == []
        assert stored_once(pair.url, reporters.acknowledged)
        assert not second.says("listening on")
        assert first.says("listening on")


def test_an_older_state_is_refused_by_a_server_that_began_anew_until_it_has_it_all(
    make_database: Callable[[], str], processes: Processes
) -> None:
    url, said, taken = make_database(), list[str](), list[Any]()
    owner, _ = Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()
    owner.create(SPEC)
    owner.close()
    follower = Follower(url, "tcp/127.0.0.1:1", said.append, known=2)
    taking = threading.Thread(target=lambda: taken.append(follower.take()))
    taking.start()
    processes.wait_until(lambda: said)
    assert "older state: it holds 1 log positions, and held 2 before; fail over to a copy" in said[0]
    assert taken == []
    other, _ = Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()  # one that never saw more
    other.append_reports(report(1))
    other.close()
    taking.join(60)
    [(log, [task])] = taken
    assert task.seq == 2
    log.close()


def test_an_older_state_is_refused_by_a_server_that_stood_by_until_it_has_it_all(
    make_database: Callable[[], str], postgres: Postgres, processes: Any
) -> None:
    url, said, taken = make_database(), list[str](), list[Any]()
    database = url.rpartition("/")[2]
    owner = Owner(url)
    owner.log.create(SPEC)
    owner.store(1)
    follower = Follower(url, "tcp/127.0.0.1:1", said.append)
    taking = threading.Thread(target=lambda: taken.append(follower.take()))
    taking.start()
    processes.wait_until(lambda: said)
    owner.store(2)
    beats = "SELECT beat FROM crkr.server ORDER BY number DESC LIMIT 1"
    [(beat,)] = postgres.execute(database, beats)
    processes.wait_until(lambda: postgres.execute(database, beats)[0][0] > beat + 2)  # it has read what was stored
    postgres.execute(database, "CREATE TABLE public.lost AS SELECT * FROM crkr.trial WHERE seq = 3")
    postgres.execute(database, "UPDATE crkr.task SET last = 2; DELETE FROM crkr.trial WHERE seq = 3")
    owner.log.close()
    processes.wait_until(lambda: "older state: it holds 2 log positions, and held 3 before" in said[-1])
    assert taken == []
    postgres.execute(database, "INSERT INTO crkr.trial SELECT * FROM public.lost; UPDATE crkr.task SET last = 3")
    taking.join(60)
    [(log, [task])] = taken
    assert task.seq == 3
    log.close()


def test_a_server_that_the_database_refuses_is_told_why_without_the_password(
    postgres: Postgres, make_database: Callable[[], str]
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
    postgres: Postgres, make_database: Callable[[], str], processes: Processes
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
