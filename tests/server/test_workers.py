"""Workers are known by liveliness tokens, notices and the names in messages."""

from collections.abc import Callable
from typing import Any

import msgpack
import pytest
import zenoh
from processes import Processes

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Plain = Callable[[str], zenoh.Session]
Until = Callable[[Callable[[], Any]], Any]


@pytest.fixture
def task(ask: Ask) -> str:
    name: str = ask("task/reach/rpc/status")["task"]
    return name


@pytest.fixture
def until(processes: Processes) -> Until:
    """The first true answer."""
    return processes.wait_until


def worker(ask: Ask, name: str) -> dict[str, Any]:
    workers: list[dict[str, Any]] = ask("task/reach/rpc/status")["workers"]
    return next((entry for entry in workers if entry["id"] == name), {})


def test_a_worker_is_alive_by_its_token_and_lost_without(
    ask: Ask, task: str, plain: Plain, shared_endpoint: str, until: Until
) -> None:
    other = plain(shared_endpoint)
    token = other.liveliness().declare_token(f"crkr/@v1/task/{task}/live/worker/ada")
    until(lambda: worker(ask, "ada").get("state") == "alive")
    assert token is not None  # held until here: a token that is let go of is undeclared
    other.close()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the type
    until(lambda: worker(ask, "ada").get("state") == "lost")


def test_odd_tokens_disturb_nobody(ask: Ask, task: str, plain: Plain, shared_endpoint: str, until: Until) -> None:
    session = plain(shared_endpoint)
    keys = ["crkr/@v1/**", "crkr/@v1/task/**", "crkr/@v1/task/*/live/*/*", f"crkr/@v1/task/{task}/live/*/eve"]
    keys += [f"crkr/@v1/task/{task}/live/dance/eve", f"crkr/@v1/task/{task}/live/left/eve"]
    tokens = [session.liveliness().declare_token(key) for key in keys]
    tokens.append(session.liveliness().declare_token(f"crkr/@v1/task/{task}/live/worker/ada"))
    until(lambda: worker(ask, "ada").get("state") == "alive")
    assert [entry["id"] for entry in ask("task/reach/rpc/status")["workers"]] == ["ada"]
    assert len(tokens) == 7  # held until here


def test_a_server_shows_itself_by_a_token(ask: Ask, plain: Plain, shared_endpoint: str) -> None:
    server_id = ask("rpc/info")["server_id"]
    replies = plain(shared_endpoint).liveliness().get("crkr/@v1/live/server/*", timeout=5.0)
    keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
    assert [key.rsplit("/", 1)[1].replace("-", "") for key in keys] == [server_id.hex()]


def test_a_trial_is_open_until_it_is_reported_by_anyone_under_that_name(ask: Ask, make_trial: MakeTrial) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    states = [[0.1, 0.1], [0.2, 0.2]]
    answer = ask("task/reach/rpc/predict", {"states": states, "explore": True, "worker": "bob"})
    assert worker(ask, "bob")["open_trials"] == 2
    late = make_trial(1, id=answer["trial_ids"][0], worker="bob")
    ask("task/reach/rpc/report", {"trials": [late]})
    assert worker(ask, "bob")["open_trials"] == 1
    assert worker(ask, "bob")["state"] == "unannounced"


def test_subscribers_hear_of_each_new_model(
    ask: Ask, task: str, make_trial: MakeTrial, plain: Plain, shared_endpoint: str, until: Until
) -> None:
    session = plain(shared_endpoint)
    notices = session.declare_subscriber(f"crkr/@v1/task/{task}/pub/model", zenoh.handlers.FifoChannel(64))
    trial = make_trial(0)

    def heard() -> dict[str, Any] | None:
        """Asks for a new version each time: the subscription may reach the router after the first ones."""
        ask("task/reach/rpc/report", {"trials": [make_trial(next(numbers), kind="evaluation")], "wait": True})
        sample = notices.try_recv()
        return None if sample is None else dict(msgpack.unpackb(sample.payload.to_bytes()))

    numbers = iter(range(1, 10_000))
    first = until(heard)
    assert (first["active"], first["added"], first["evicted"]) == (0, [], [])
    version = ask("task/reach/rpc/report", {"trials": [trial], "wait": True})["model_version"]
    notice: dict[str, Any] = first
    while notice["version"] < version:
        notice = msgpack.unpackb(notices.recv().payload.to_bytes())
    assert notice == {"version": version, "active": 1, "added": [trial["id"]], "evicted": []}
