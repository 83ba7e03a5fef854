"""A client asks by way of any transport; the one over Zenoh has tests of its own."""

import time
from collections.abc import Sequence

import pytest

from crkr.client import Client, Presence, Role, Subscription
from crkr.protocol import Invalid, TaskSpec, Unavailable, UnknownTask, pack, unpack

AXIS = {"name": "x", "low": 0.0, "high": 1.0}
SPEC = TaskSpec.from_dict({"name": "throw", "state": [AXIS], "goal": [AXIS]})


class Memory:
    """Answers from a dictionary, by the key's last word."""

    endpoint = "memory"

    def __init__(self, **answers: object) -> None:
        self.answers = answers
        self.asked: list[tuple[str, dict[str, object], float]] = []
        self.published: list[tuple[str, bytes]] = []
        self.closed = False

    def query(
        self, key: str, kind: str, payload: bytes, deadline: float, *, patient: bool = False, optional: bool = False
    ) -> bytes:
        del patient, optional
        self.asked.append((key, unpack(payload), deadline))
        answer = self.answers.get(kind, UnknownTask("no such task"))
        if isinstance(answer, Exception):
            raise answer
        assert isinstance(answer, dict)
        return pack(answer)

    def publish(self, key: str, kind: str, payload: bytes) -> None:
        del kind
        self.published.append((key, payload))

    def subscribe(self, task: str, topics: Sequence[str], capacity: int, deadline: float) -> Subscription:
        raise Unavailable(f"no publications of {task} {topics} {capacity} {deadline}")

    def announce(self, task: str, worker_id: str, deadline: float) -> Presence:
        raise Unavailable(f"nobody sees {worker_id} of {task} by {deadline}")

    def take_role(self, task: str, role: str, deadline: float) -> Role | None:
        del task, role, deadline
        return None  # taken by another

    def close(self) -> None:
        self.closed = True


def test_a_client_asks_its_transport_and_closes_it() -> None:
    memory = Memory(info={"server_id": bytes(16), "version": "1"}, spec={"spec": SPEC.to_dict()})
    with Client(transport=memory, timeout_s=3.0) as client:
        before = time.monotonic()
        assert client.info()["version"] == "1"
        assert client.server_id().int == 0
        assert client.task("throw").spec == SPEC
        assert client.take_role("throw", "judge") is None
        client.task("throw").publish("trial", {"n": 1})
    assert [key for key, _, _ in memory.asked] == ["crkr/@v1/rpc/info"] * 2 + ["crkr/@v1/task/throw/rpc/spec"]
    assert before + 3.0 <= memory.asked[0][2] <= time.monotonic() + 3.0
    assert memory.published == [("crkr/@v1/task/throw/pub/trial", pack({"n": 1}))]
    assert memory.closed
    assert client.endpoint == "memory"


def test_an_error_of_the_transport_is_the_error_of_the_call() -> None:
    client = Client(transport=Memory())
    with pytest.raises(UnknownTask, match="no such task"):
        client.task("throw").status()
    with pytest.raises(Unavailable, match="no publications of throw"):
        client.task("throw").subscribe()


def test_an_endpoint_and_a_transport_together_are_refused() -> None:
    with pytest.raises(Invalid, match="not both"):
        Client("tcp/127.0.0.1:7447", transport=Memory())
