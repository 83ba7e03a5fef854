"""Answers are the server's or they are ignored, and goals that a task cannot have are not given to a robot."""

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import msgpack
import numpy as np
import pytest
import zenoh
from processes import Processes, RunningServer
from putt_task import practise, specification

from crkr.client import Client, Task
from crkr.learner import Learner
from crkr.protocol import Internal, Unavailable, pack, unpack

PATIENCE_S = 20.0
TASK = "crkr/@v1/task"
KEYS = [
    (f"{TASK}/*/rpc/*", True),
    (f"{TASK}/*/rpc/predict", True),
    (f"{TASK}/*/rpc/*", False),
    ("crkr/@v1/**", True),
    ("crkr/@v1/**", False),
]


def forged(verb: str, request: dict[str, Any]) -> dict[str, Any]:
    """An answer that looks like the server's."""
    if verb == "report":
        count = len(request["trials"])
        return {"accepted": count, "duplicates": 0, "seqs": [2**40] * count, "model_version": 2**41}
    nothing = np.zeros(3)
    return {
        "goals": np.array([np.nan, 1e9, 0.0]),
        "means": nothing,
        "sigmas": nothing,
        "novelty": np.array(0.0),
        "trial_ids": request.get("trial_ids", [bytes(16)]),
        "model_version": 2**40,
        "active": 1,
        "policy": "mean",
        "compute_us": 1,
    }


class Rogue:
    """A client that declares the server's own queryables."""

    def __init__(self, session: zenoh.Session, key: str, complete: bool, answer: Callable[[zenoh.Query, str], None]):
        self.asked = 0
        self._answer, self.lock = answer, threading.Lock()
        self._queryable = session.declare_queryable(key, self._hear, complete=complete)
        for _ in session.liveliness().get("crkr/@v1/live/none", timeout=PATIENCE_S):  # the declaration has arrived too
            pass

    def _hear(self, query: zenoh.Query) -> None:
        with query:
            self.asked += 1
            self._answer(query, str(query.key_expr).rpartition("/")[2])


def lie(query: zenoh.Query, verb: str) -> None:
    request = msgpack.unpackb(query.payload.to_bytes()) if query.payload else {}
    for _ in range(8):  # more than the client's channel holds
        query.reply(query.key_expr, pack(forged(verb, request)))


def refuse(query: zenoh.Query, _: str) -> None:
    query.reply_err(pack({"code": "INVALID", "message": "no"}))


@contextmanager
def session(endpoint: str, **settings: Any) -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    usual = {"mode": "client", "connect/endpoints": [endpoint], "connect/timeout_ms": 0}
    for name, value in {
        **usual,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        **settings,
    }.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config) as opened:
        yield opened


@pytest.fixture
def task(shared_endpoint: str) -> Iterator[Task]:
    with Client(shared_endpoint, timeout_s=PATIENCE_S) as client:
        task = client.create_task(specification())
        practise(task, 20, 1)
        yield task


@pytest.mark.parametrize(("key", "complete"), KEYS)
@pytest.mark.parametrize("answer", [lie, refuse])
def test_another_client_that_answers_on_the_servers_keys_is_not_believed(
    task: Task, shared_endpoint: str, key: str, complete: bool, answer: Any
) -> None:
    with session(shared_endpoint) as stranger:
        rogue = Rogue(stranger, key, complete, answer)
        for number in range(10):
            asked = task.predict([0.1 * number, 0.5], explore=True)
            assert (np.abs(asked.goal) <= 1).all()
            receipt = task.report(asked, cost=0.5, success=True)
            assert receipt.seqs[0] < 2**40
        assert sum(task.status()["samples"].values()) == 30
        assert rogue.asked >= 10


def test_an_outbox_ignores_other_clients_answers_too(task: Task, shared_endpoint: str, tmp_path: Path) -> None:
    with session(shared_endpoint) as stranger, task.outbox(tmp_path / "box") as outbox:
        Rogue(stranger, "crkr/@v1/**", True, lie)
        for number in range(20):
            outbox.report(state=[0.05 * number, 0.5], goal=[0.0, 0.0, 0.0], cost=0.5, success=True)
        outbox.flush(PATIENCE_S)
        assert sum(task.status()["samples"].values()) == 40


def test_one_that_claims_the_servers_zenoh_id_is_not_let_in(shared_endpoint: str) -> None:
    with session(shared_endpoint) as honest:
        [server] = honest.info.routers_zid()
        with pytest.raises(zenoh.ZError), session(shared_endpoint, id=str(server), **{"connect/timeout_ms": 1000}):
            pass


def test_the_doctor_tells_of_one_that_answers_in_the_servers_place(shared_endpoint: str) -> None:
    with session(shared_endpoint) as stranger:
        Rogue(stranger, "crkr/@v1/**", True, lie)
        command = [sys.executable, "-m", "crkr.client", "doctor", "--connect", shared_endpoint, "--json"]
        done = subprocess.run(command, stdout=subprocess.PIPE, timeout=60, check=False)
        checks = {check["check"]: check for check in json.loads(done.stdout)["checks"]}
        assert (done.returncode, checks["trust"]["ok"], checks["reachable"]["ok"]) == (1, False, True)
        assert "another client answers" in checks["trust"]["detail"]


def test_without_a_server_another_client_s_answer_is_named_and_ignored(make_peer: Any) -> None:
    peer = make_peer([{"protocol": 1}, "silence"])
    with Client(peer.endpoint, timeout_s=1.0) as client, session(peer.endpoint) as stranger:
        client.info()
        Rogue(stranger, "crkr/@v1/**", True, lie)
        with pytest.raises(Unavailable, match="of another client, not of the server"):
            client.info()


def test_a_server_that_restarts_is_believed_again(start_server: Callable[..., RunningServer], free_port: int) -> None:
    first = start_server(port=free_port)
    with Client(first.endpoint, timeout_s=PATIENCE_S) as client:
        before = client.info()["server_id"]
        first.process.terminate()
        first.process.wait()
        start_server(port=free_port)
        assert client.info()["server_id"] != before


def test_behind_another_router_the_first_server_is_believed_until_it_is_gone(
    start_server: Callable[..., RunningServer], free_port: int, processes: Processes
) -> None:
    """A router in between answers nothing itself, so that the server is known only by having answered first."""
    server = start_server()
    between = f"tcp/127.0.0.1:{free_port}"
    router = {"mode": "router", "listen/endpoints": [between], "scouting/delay": 0}
    with session(server.endpoint, **router), Client(between, timeout_s=PATIENCE_S) as client:
        before = client.info()["server_id"]
        with session(between) as stranger:
            Rogue(stranger, "crkr/@v1/**", True, lie)
            for _ in range(10):
                assert client.info()["server_id"] == before
        server.process.terminate()
        server.process.wait()
        start_server(port=server.port)
        assert client.info()["server_id"] != before


def learned(spec: Any) -> tuple[Learner, dict[str, Any]]:
    learner = Learner(spec)
    learner.report(state=np.random.default_rng(0).uniform(0, 1, (9, 2)), goal=np.zeros((9, 3)), cost=0.1, success=True)
    return learner, unpack(pack(learner.model.to_wire()))


@pytest.mark.parametrize("goal", [[0.0, 0.0, 1.0001], [np.nan, 0.0, 0.0], [0.0, -np.inf, 0.0]])
@pytest.mark.parametrize("batch", [False, True])
def test_goals_that_the_task_cannot_have_are_refused(make_peer: Any, goal: list[float], batch: bool) -> None:
    """Also from the server itself, which may have a defect."""
    spec = specification()
    listing = {"spec": spec.to_dict(), "archived": False, "model_version": 9}
    states = np.full((2, 2), 0.5) if batch else np.full(2, 0.5)
    ids = [uuid4() for _ in range(2 if batch else 1)]
    learner, _ = learned(spec)
    answer = unpack(pack(learner.predict(states, trial_ids=ids).to_wire()))
    goals = np.zeros((2, 3)) if batch else np.zeros(3)
    goals[..., :] = goal
    wrong = {**answer, "goals": goals}
    peer = make_peer([msgpack.packb(listing), pack(answer), pack(wrong), msgpack.packb(listing)])
    with Client(peer.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.task(spec.name)
        assert task.predict(states, trial_ids=ids).goals.shape == goals.shape
        with pytest.raises(Internal, match=r"outside the bounds: '[ghi]' must be in"):
            task.predict(states, trial_ids=ids)


def test_an_answer_about_other_trials_than_those_asked_about_is_refused(make_peer: Any) -> None:
    spec = specification()
    listing = {"spec": spec.to_dict(), "archived": False, "model_version": 9}
    learner, _ = learned(spec)
    answer = pack(learner.predict([0.5, 0.5], trial_ids=[UUID(int=1)]).to_wire())
    peer = make_peer([msgpack.packb(listing), answer, msgpack.packb(listing)])
    with Client(peer.endpoint, timeout_s=PATIENCE_S) as client, pytest.raises(Internal, match="other trials"):
        client.task(spec.name).predict(np.array([0.5, 0.5]))


@pytest.mark.parametrize("accepted", [0, 1, 3])
def test_a_receipt_for_another_number_of_trials_is_none(make_peer: Any, accepted: int) -> None:
    spec = specification()
    listing = {"spec": spec.to_dict(), "archived": False, "model_version": 9}
    receipt = {"accepted": accepted, "duplicates": 0, "seqs": list(range(accepted)), "model_version": 1}
    peer = make_peer([msgpack.packb(listing), receipt])
    with Client(peer.endpoint, timeout_s=PATIENCE_S) as client, pytest.raises(Internal, match="acknowledges"):
        client.task(spec.name).report(state=np.zeros((2, 2)), goal=np.zeros((2, 3)), cost=0.1, success=True)


@pytest.mark.parametrize(
    "change",
    [
        {"goals": np.full((9, 3), 7.0)},
        {"goals": np.full((9, 3), np.nan)},
        {"bounds": {"low": np.full(3, -9.0), "high": np.full(3, 9.0)}},
    ],
    ids=["goals beyond the bounds", "goals that are no numbers", "other bounds"],
)
def test_a_mirror_takes_over_no_model_that_the_task_cannot_have(make_peer: Any, change: dict[str, Any]) -> None:
    spec = specification()
    listing = msgpack.packb({"spec": spec.to_dict(), "archived": False, "model_version": 9})
    _, model = learned(spec)
    info = {"server_id": uuid4().bytes}
    peer = make_peer([listing, info, pack({**model, **change}), listing])
    with Client(peer.endpoint, timeout_s=PATIENCE_S) as client:
        task = client.task(spec.name)
        assert task.spec == spec
        with pytest.raises(Internal, match="answer to model cannot be read"):
            task.mirror()
