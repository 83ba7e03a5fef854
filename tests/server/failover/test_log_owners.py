"""One server at a time writes to a shared log, whatever befalls it, the database, or the server that takes over."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any
from uuid import UUID, uuid4

import psycopg
import pytest
from postgres import Postgres, TcpLink
from processes import Processes
from psycopg import sql

from crkr.protocol import ShuttingDown, StorageError, TaskSpec, Trial
from crkr.server.follower import Follower
from crkr.server.log import PendingReport, Stored
from crkr.server.log.access import database_summary, open_unserved
from crkr.server.log.postgres.lease import Lease
from crkr.server.log.postgres.log import PostgresLog

AXIS = {"name": "x", "low": -1.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "reach", "state": [AXIS], "goal": [AXIS]})


def report(number: int) -> list[PendingReport]:
    trial = Trial.create(SPEC, id=UUID(int=number), state=[0.1], goal=[0.2], cost=0.5, success=True, kind="trial")
    return [PendingReport("reach", (trial,))]


class Owner:
    """A log as a server holds it, and why it lost it."""

    def __init__(self, url: str, *, beats: bool = True) -> None:
        self.lost = threading.Event()
        self.why: list[str] = []
        self.log, self.tasks = Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()
        if beats:
            self.log.keep(self.lose)

    def lose(self, why: str) -> None:
        self.why.append(why)
        self.lost.set()

    def store(self, number: int) -> Any:
        """As the write lane does."""
        recovered = self.log.recover()
        [stored] = self.log.append_reports(report(number))
        assert isinstance(stored, Stored)
        return recovered, stored.seqs


@pytest.fixture
def url(make_database: Callable[[], str]) -> str:
    return make_database()


@pytest.fixture
def own(url: str) -> Iterator[Callable[..., Owner]]:
    """Takes the log of the test's database, which is closed at the end."""
    with ExitStack() as stack:

        def owner(**how: Any) -> Owner:
            made = Owner(url, **how)
            stack.callback(made.log.close)
            return made

        yield owner


@pytest.fixture
def run(postgres: Postgres, url: str) -> Callable[[Any], list[tuple[Any, ...]]]:
    """Runs a statement in the test's database."""
    return lambda statement: postgres.execute(url.rpartition("/")[2], statement)


def cut(run: Callable[[Any], Any]) -> None:
    """Ends every connection to the database but the one that asks."""
    run(
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = current_database() "
        "AND pid <> pg_backend_pid()"
    )


def test_of_two_owners_the_later_one_writes_and_the_earlier_one_leaves(own: Callable[..., Owner]) -> None:
    first = own(beats=False)
    first.log.create(SPEC)
    assert first.store(1) == ([], (2,))
    second = own()  # after three seconds without a sign of life
    assert [task.seq for task in second.tasks] == [2]
    assert second.store(2) == ([], (3,))
    with pytest.raises(ShuttingDown, match="the log has moved on"):
        first.log.append_reports(report(3))
    first.log.keep(first.lose)
    with pytest.raises(ShuttingDown, match="another server owns task 'reach' now"):
        first.log.recover()
    assert first.lost.wait(10)
    assert second.store(3) == ([], (4,))
    assert not second.lost.is_set()


def test_an_owner_that_lives_is_not_replaced_and_one_that_leaves_is_at_once(
    own: Callable[..., Owner], url: str
) -> None:
    first = own()
    first.log.create(SPEC)
    lease = Lease(url)
    [serving] = lease.look().serving
    assert serving.connected
    stale, [seen] = lease.look(), lease.tasks()
    first.log.close()
    assert lease.look().serving == []
    assert not lease.join(stale)  # the servers are others since
    assert lease.join(lease.look())
    [taken] = lease.take([seen])
    assert (taken.owner, taken.epoch) == (lease.me, seen.epoch + 1)
    assert lease.take([seen]) == []  # it changed hands since
    lease.give_up()


def test_a_server_that_restores_for_long_is_not_taken_for_dead(url: str, processes: Any) -> None:
    busy, other = Lease(url), Lease(url)

    def beat() -> int:
        return next(member.beat for member in other.look().members if member.id == busy.me)

    before = beat()
    with busy.beating():
        processes.wait_until(lambda: beat() > before + 1)
    busy.give_up()
    other.give_up()


def test_a_server_that_dies_while_it_takes_over_is_replaced_in_turn(
    own: Callable[..., Owner], url: str, run: Callable[[Any], Any]
) -> None:
    own(beats=False).log.create(SPEC)
    cut(run)
    half = Lease(url)
    assert half.join(half.look())
    half.take(half.tasks())
    cut(run)  # before it restored anything
    half.give_up()
    third = own()
    assert third.store(1) == ([], (2,))
    assert run("SELECT epoch FROM crkr.task") == [(3,)]


def test_a_connection_that_ends_is_made_anew_and_nothing_is_stored_twice(
    own: Callable[..., Owner], run: Callable[[Any], Any]
) -> None:
    owner = own()
    owner.log.create(SPEC)
    owner.store(1)
    cut(run)
    with pytest.raises(ShuttingDown, match="the database is away"):
        owner.store(2)
    recovered, seqs = owner.store(2)
    assert (recovered, seqs) == ([], (3,))
    assert [entry.seq for entry in owner.log.reads.read("reach")] == [1, 2, 3]
    assert not owner.lost.is_set()


def test_what_was_stored_though_its_connection_was_lost_is_read_back(
    postgres: Postgres, url: str, run: Callable[[Any], Any], processes: Processes
) -> None:
    with TcpLink(postgres.port) as link:
        owner = Owner(url.replace(f":{postgres.port}/", f":{link.port}/"), beats=False)
        owner.log.create(SPEC)
        owner.store(1)
        link.hold_answers()
        failures: list[BaseException] = []

        def store() -> None:
            try:
                owner.store(2)
            except BaseException as error:
                failures.append(error)

        storing = threading.Thread(target=store)
        storing.start()
        processes.wait_until(lambda: run("SELECT last FROM crkr.task") == [(3,)])
        link.cut()
        storing.join(30)
        assert [type(error) for error in failures] == [ShuttingDown]
        with pytest.raises(ShuttingDown):
            owner.store(2)
        link.mend()
        recovered, seqs = owner.store(2)
        assert [(name, [entry.seq for entry in entries]) for name, entries in recovered] == [("reach", [3])]
        assert seqs == (3,)
        assert [entry.seq for entry in owner.log.reads.read("reach")] == [1, 2, 3]
        owner.log.close()


def test_a_database_that_went_back_is_refused_with_the_reason(
    own: Callable[..., Owner], url: str, postgres: Postgres, run: Callable[[Any], Any]
) -> None:
    owner = own(beats=False)
    owner.log.create(SPEC)
    owner.store(1)
    name, older = url.rpartition("/")[2], f"older-{uuid4()}"
    cut(run)
    postgres.execute("postgres", sql.SQL("CREATE DATABASE {} TEMPLATE {}").format(*map(sql.Identifier, (older, name))))
    with pytest.raises(ShuttingDown):
        owner.store(2)
    owner.store(2)
    cut(run)
    for before, after in ((name, f"{older}-newer"), (older, name)):
        names = map(sql.Identifier, (before, after))
        postgres.execute("postgres", sql.SQL("ALTER DATABASE {} RENAME TO {}").format(*names))
    with pytest.raises(ShuttingDown):
        owner.store(3)
    for _ in range(2):
        with pytest.raises(StorageError, match="older state: it holds 2 log positions of task 'reach', and 3 were"):
            owner.store(3)


def test_a_database_that_takes_no_writes_is_named_and_may_be_opened_again(
    own: Callable[..., Owner], url: str, postgres: Postgres, run: Callable[[Any], Any]
) -> None:
    owner = own(beats=False)
    owner.log.create(SPEC)
    name = sql.Identifier(url.rpartition("/")[2])
    run(sql.SQL("ALTER DATABASE {} SET default_transaction_read_only = on").format(name))
    cut(run)
    with pytest.raises(ShuttingDown):
        owner.store(1)
    with pytest.raises(StorageError, match="takes no writes: name the primary"):
        owner.store(1)
    postgres.execute("postgres", sql.SQL("ALTER DATABASE {} RESET ALL").format(name))
    cut(run)
    with pytest.raises(ShuttingDown):
        owner.store(1)
    assert owner.store(1) == ([], (2,))


def test_a_database_without_free_connections_is_away_until_it_has_some(
    url: str, postgres: Postgres, run: Callable[[Any], Any]
) -> None:
    role = sql.Identifier(f"role-{uuid4()}")
    run(sql.SQL("CREATE ROLE {} LOGIN").format(role))
    run(sql.SQL("GRANT CREATE ON DATABASE {} TO {}").format(sql.Identifier(url.rpartition("/")[2]), role))
    limited = postgres.url(url.rpartition("/")[2], role.as_string().strip('"'))
    owner = Owner(limited)
    owner.log.create(SPEC)
    run(sql.SQL("ALTER ROLE {} CONNECTION LIMIT 0").format(role))
    cut(run)
    for _ in range(2):
        with pytest.raises(ShuttingDown, match="the database is away"):
            owner.store(1)
    run(sql.SQL("ALTER ROLE {} CONNECTION LIMIT -1").format(role))
    assert owner.store(1) == ([], (2,))
    owner.log.close()


def test_a_lock_that_another_program_holds_makes_reports_wait_and_not_the_server_hang(
    own: Callable[..., Owner], url: str
) -> None:
    owner = own()
    owner.log.create(SPEC)
    with psycopg.connect(url) as other:
        other.execute("LOCK TABLE crkr.trial")
        with pytest.raises(ShuttingDown, match=r"the database is away .*lock timeout"):
            owner.store(1)
    assert owner.store(1) == ([], (2,))
    assert not owner.lost.is_set()


def test_a_command_that_writes_keeps_the_log_and_gives_it_up_where_it_is_damaged(
    url: str, run: Callable[[Any], Any], processes: Processes
) -> None:
    log = open_unserved(url)
    [(beat,)] = run("SELECT beat FROM crkr.server")
    processes.wait_until(lambda: run("SELECT beat FROM crkr.server")[0][0] > beat + 1)
    log.create(SPEC)
    log.append_reports(report(1))
    log.close()
    run("DELETE FROM crkr.trial")
    with pytest.raises(StorageError, match="holds 1 entries, but 2 were acknowledged"):
        open_unserved(url)
    assert run("SELECT id FROM crkr.server") == []


def test_tables_of_another_version_or_another_program_are_refused(
    own: Callable[..., Owner], url: str, run: Any
) -> None:
    own().log.close()
    run("UPDATE crkr.log SET version = 99")
    with pytest.raises(StorageError, match="schema version 99, this crkr knows 2: use a newer crkr"):
        Lease(url)
    run("UPDATE crkr.log SET version = 2")
    run("DROP TABLE crkr.cache")
    with pytest.raises(StorageError, match="lacks its table 'cache'"):
        Lease(url)


def test_a_log_that_lacks_acknowledged_entries_is_not_opened(own: Callable[..., Owner], url: str, run: Any) -> None:
    first = own()
    first.log.create(SPEC)
    first.store(1)
    first.log.close()
    run("DELETE FROM crkr.trial")
    with pytest.raises(StorageError, match="holds 1 entries, but 2 were acknowledged"):
        Follower(url, "tcp/127.0.0.1:1", lambda _: None).take()
    assert isinstance(first.log, PostgresLog)


def test_of_reports_stored_together_those_of_a_task_that_was_taken_are_refused(
    own: Callable[..., Owner], url: str
) -> None:
    log = own(beats=False).log
    log.create(SPEC)
    log.create(replace(SPEC, name="throw"))
    lease = Lease(url)
    lease.take([row for row in lease.tasks() if row.name == "throw"])
    [reach] = report(1)
    stored, refused = log.append_reports([reach, replace(reach, task="throw")])
    assert isinstance(stored, Stored)
    assert isinstance(refused, ShuttingDown)
    assert log.reads.positions() == {"reach": 2, "throw": 1}
    lease.give_up()


def test_the_doctor_says_what_stands_in_a_database_and_who_owns_it(own: Callable[..., Owner], url: str) -> None:
    with pytest.raises(StorageError, match="there is no task log in postgresql://"):
        database_summary(url)
    owner = own()
    owner.log.create(SPEC)
    owner.store(1)
    assert database_summary(url) == "1 tasks with 2 log positions; served at 127.0.0.1:1"
    owner.log.close()
    assert database_summary(url) == "1 tasks with 2 log positions; no server owns it"
