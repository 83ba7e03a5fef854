"""A server that proposes goals no robot may try, written with Zenoh and msgpack alone."""

import socket
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import Pipe
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from crkr.client import Client
from crkr.protocol import Internal, TaskSpec
from crkr.sim_worker import SkillOptions, load_skill
from crkr.sim_worker.supervisor.child_process import MessagePipe
from crkr.sim_worker.worker.supervisor_link import SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry
from crkr.sim_worker.worker.trial_loop import Identity, TrialLoop

pytestmark = pytest.mark.usefixtures("skills_here")


def wire(numbers: list[float], shape: list[int]) -> dict[str, Any]:
    return {"shape": shape, "dtype": "<f8", "data": struct.pack(f"<{len(numbers)}d", *numbers)}


@dataclass
class Rogue:
    """Answers with these goals in turn, the last one forever, and keeps what is reported."""

    endpoint: str
    spec: dict[str, Any]
    goals: list[list[float]] = field(default_factory=list)
    reported: list[dict[str, Any]] = field(default_factory=list)

    def answer(self, verb: str, asked: dict[str, Any]) -> dict[str, Any]:
        if verb == "spec":
            return {"spec": self.spec}
        if verb == "predict":
            goal = self.goals.pop(0) if len(self.goals) > 1 else self.goals[0]
            rest = {"trial_ids": asked["trial_ids"], "model_version": 1, "active": 1, "policy": "explore"}
            spread = {"sigmas": wire([0.1, 0.1], [2]), "novelty": wire([0.0], []), "compute_us": 1}
            return {"goals": wire(goal, [2]), "means": wire(goal, [2]), **spread, **rest}
        self.reported += asked["trials"]
        return {"accepted": 1, "duplicates": 0, "seqs": [2], "model_version": 2}

    def serve(self, queries: Any) -> None:
        while True:
            try:
                query = queries.recv()
            except zenoh.ZError:  # the session is closed
                return
            with query:
                key = str(query.key_expr)
                asked = msgpack.unpackb(query.payload.to_bytes())
                query.reply(key, msgpack.packb(self.answer(key.rpartition("/")[2], asked)))


@pytest.fixture
def rogue() -> Iterator[Rogue]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("scouting/delay", "0")
    spec: TaskSpec = load_skill("reaching:make", SkillOptions(name="reaching")).spec()
    made = Rogue(endpoint, spec.to_dict())
    with zenoh.open(config) as session:
        queries = session.declare_queryable("crkr/@v1/**", zenoh.handlers.FifoChannel(64), complete=True)
        thread = threading.Thread(target=made.serve, args=(queries,))
        thread.start()
        yield made
    thread.join(60.0)


@pytest.fixture
def client(rogue: Rogue) -> Iterator[Client]:
    with Client(rogue.endpoint) as client:
        yield client


@pytest.fixture
def loop(client: Client) -> Iterator[TrialLoop]:
    skill = load_skill("reaching:make", SkillOptions(name="reaching"))
    ours, theirs = Pipe()
    with ours, theirs:
        task = client.task("reaching")
        yield TrialLoop(task, skill, Identity("one", 7, 1), SupervisorLink(MessagePipe(ours), 5.0), Telemetry(task, ()))


BAD = [[np.nan, 0.0], [0.0, np.inf], [0.0, 1.5000001]]


def test_a_goal_that_no_robot_may_try_is_no_trial_but_telemetry(rogue: Rogue, client: Client, loop: TrialLoop) -> None:
    rogue.goals = [*BAD, [0.25, 0.5]]
    with client.task("reaching").subscribe(["trial"]) as published:  # of its own session: known before the first trial
        trial = loop.run_one()
        seen = [published.receive(10.0) for _ in range(4)]
    assert trial.goal.tolist() == [0.25, 0.5]
    assert [one["kind"] for one in rogue.reported] == ["trial"]
    messages = [message for _, message in (one for one in seen if one is not None)]
    assert [message["info"]["reason"] for message in messages[:3]] == ["invalid"] * 3
    assert ["seq" in message for message in messages] == [False, False, False, True]


def test_a_server_that_proposes_nothing_else_is_given_up(rogue: Rogue, loop: TrialLoop) -> None:
    rogue.goals = [[np.nan, 0.0]]
    with pytest.raises(Internal, match="10 goals in a row are out of the bounds of task 'reaching' or not finite"):
        loop.run_one()
    assert rogue.reported == []
