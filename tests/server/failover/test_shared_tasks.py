"""Two servers share the tasks of a log: either answers for all, and what one leaves the other takes."""

import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from postgres import Postgres, TcpLink
from processes import Processes

from crkr.client import Client
from crkr.protocol import Conflict, ShuttingDown, TaskSpec, UnknownTask
from crkr.server.log.postgres.lease import Lease
from crkr.server.log.postgres.log import PostgresLog
from crkr.server.membership import Membership
from crkr.server.server import Server, ServerSettings

from .test_failover import check_log

AXES = [{"name": name, "low": -1.0, "high": 1.0} for name in "xy"]
SPEC = TaskSpec.from_dict({"name": "reach", "state": AXES, "goal": AXES, "budget": 30})
NAMES = ("a", "b", "c", "d")
OWNED = """SELECT server.number, count(*) FROM crkr.task JOIN crkr.server ON owner = server.id
           GROUP BY server.number ORDER BY server.number"""


@pytest.fixture
def shares(postgres: Postgres) -> Callable[[Any], list[int]]:
    """How many tasks each living server owns, those first that came first."""
    return lambda pair: [count for _, count in postgres.execute(pair.url.rpartition("/")[2], OWNED)]


def test_tasks_are_shared_and_either_server_answers_for_all(
    make_pair: Callable[..., Any],
    shares: Callable[[Any], list[int]],
    processes: Processes,
    caplog: pytest.LogCaptureFixture,
) -> None:
    pair = make_pair(peer="")
    with (
        Client(pair.members[0].endpoint, timeout_s=30) as here,
        Client(pair.members[1].endpoint, timeout_s=30) as there,
    ):
        for name in NAMES:
            made, seen = (here, there) if name in "ab" else (there, here)
            made.create_task(replace(SPEC, name=name))
            made.task(name).report(state=[0.1, 0.2], goal=[0.3, 0.4], cost=0.5, success=True, wait=True)
            assert seen.task(name).predict([0.1, 0.2]).model_version == 2
        processes.wait_until(lambda: shares(pair) == [2, 2])
        caplog.clear()
        with Client(pair.members[0].endpoint, timeout_s=30) as fresh:
            assert [fresh.task(name).predict([0.1, 0.2]).model_version for name in NAMES] == [2] * 4
        assert "another client's" not in caplog.text  # it does not take the other server for a stranger
        for client in (here, there):
            processes.wait_until(lambda client=client: [one["samples"] for one in client.tasks()] == [1] * 4)
            assert [one["spec"].name for one in client.tasks()] == list(NAMES)
            assert client.info()["tasks"] == list(NAMES)
            client.create_task(replace(SPEC, name="a"))  # it is there already
            with pytest.raises(Conflict, match="exists with other budget"):
                client.create_task(replace(SPEC, name="d", budget=31))
            with pytest.raises(UnknownTask, match="no task 'nowhere' here; there are: a, b, c, d"):
                client.task("nowhere").predict([0.1, 0.2])
            for name in NAMES:
                assert client.task(name).status()["seq"] == 2
        assert here.server_id() == there.server_id()


def test_tasks_go_from_server_to_server_under_load(
    make_pair: Callable[..., Any],
    start_reporters: Callable[..., Any],
    shares: Callable[[Any], list[int]],
    processes: Processes,
) -> None:
    pair = make_pair(peer="")
    reporters = start_reporters(pair, NAMES)
    first, second = pair.members
    first.options = ("--peer", second.endpoint)

    def go_on() -> None:
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 40)

    for member, how in ((second, signal.SIGKILL), (first, signal.SIGTERM), (second, signal.SIGSTOP)):
        processes.wait_until(lambda: shares(pair) == [2, 2])
        go_on()
        member.send(how)
        processes.wait_until(lambda: shares(pair) == [4])
        go_on()
        if how == signal.SIGSTOP:
            member.send(signal.SIGCONT)
            processes.wait_until(lambda member=member: member.says("leaves the log"), member.log)
        else:
            member.start()
    processes.wait_until(lambda: shares(pair) == [2, 2])
    go_on()
    reporters.end()
    assert reporters.failed == []
    check_log(pair.url, reporters.acknowledged)


@pytest.mark.parametrize("silently", [False, pytest.param(True, marks=pytest.mark.campaign)])
def test_of_two_servers_whose_link_is_cut_the_later_one_stands_by(
    silently: bool,
    make_pair: Callable[..., Any],
    start_reporters: Callable[..., Any],
    shares: Callable[[Any], list[int]],
    processes: Processes,
    unused_ports: list[int],
) -> None:
    with TcpLink(unused_ports[0]) as link:
        pair = make_pair(peer=f"tcp/127.0.0.1:{link.port}")
        reporters = start_reporters(pair, NAMES)
        processes.wait_until(lambda: shares(pair) == [2, 2])
        if silently:
            link.fall_silent()
        else:
            link.cut()
        processes.wait_until(lambda: pair.members[1].says("is cut"), pair.members[1].log)
        processes.wait_until(lambda: shares(pair) == [4])
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 40)
        link.mend()
        processes.wait_until(lambda: shares(pair) == [2, 2])
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda: reporters.failed or len(reporters.acknowledged) > reached + 40)
        reporters.end()
        assert reporters.failed == []
        check_log(pair.url, reporters.acknowledged)


@pytest.mark.campaign
def test_a_peer_that_is_cut_off_from_the_database_leaves_its_tasks_to_the_other(
    postgres: Postgres,
    make_pair: Callable[..., Any],
    start_reporters: Callable[..., Any],
    shares: Callable[[Any], list[int]],
    processes: Processes,
) -> None:
    with TcpLink(postgres.port) as link:
        pair = make_pair(link.port, peer="")
        reporters = start_reporters(pair, NAMES)
        first = pair.members[0]
        processes.wait_until(lambda: shares(pair) == [2, 2])
        link.cut()
        processes.wait_until(lambda: first.says("another server took its tasks"), first.log)
        reached = len(reporters.acknowledged)
        processes.wait_until(lambda: len(reporters.acknowledged) > reached + 40)
        assert shares(pair) == [4]
        link.mend()
        processes.wait_until(lambda: first.says("standing by"), first.log)
        reporters.end()
        check_log(pair.url, reporters.acknowledged)


def test_a_server_that_does_not_reach_the_others_closes_what_it_opened(
    pair: Any, free_port: int, processes: Processes
) -> None:
    lease = Lease(pair.url, free_port)
    lease.look()
    log = PostgresLog(pair.url, lease)
    settings = ServerSettings(pair.url, f"tcp/127.0.0.1:{free_port}")
    with pytest.raises(ShuttingDown, match="not reached"):
        Server(settings, log, [], Membership(log, lambda _: None))
    processes.wait_until(lambda: not any(thread.name == "lease" for thread in threading.enumerate()))
