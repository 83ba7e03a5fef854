"""Every refusal has its code, and a request that cannot be read harms nobody."""

from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]


def code(reply: dict[str, Any]) -> str:
    return str(reply["error"]["code"])


def test_each_refusal_has_its_code(ask: Ask, make_trial: MakeTrial, reach: dict[str, Any]) -> None:
    predict = "task/reach/rpc/predict"
    assert code(ask(predict, {"states": [0.1, 0.2]})) == "NO_SAMPLES"
    assert code(ask("task/nobody/rpc/predict", {"states": [0.1, 0.2]})) == "UNKNOWN_TASK"
    assert code(ask("task/nobody/admin/archive")) == "UNKNOWN_TASK"
    assert code(ask("task/reach/rpc/dance")) == "UNSUPPORTED"
    assert code(ask("rpc/dance")) == "UNSUPPORTED"
    assert code(ask("rpc/info", encoding="application/msgpack;crkr.info.v2")) == "UNSUPPORTED"
    assert code(ask("rpc/info", encoding="application/json")) == "UNSUPPORTED"
    assert code(ask("rpc/create_task", {**reach, "name": "Reach!"})) == "INVALID"
    assert code(ask("rpc/create_task", {**reach, "seed": 8})) == "CONFLICT"
    assert code(ask(predict, {"states": [0.1]})) == "INVALID"
    assert code(ask(predict, {"states": [[0.1, 0.2]] * 4097})) == "INVALID"
    assert code(ask(predict, {"states": [float("nan"), 0.0]})) == "INVALID"
    assert code(ask(predict, {"states": [0.1, 0.2], "trial_ids": [b"short"]})) == "INVALID"
    assert code(ask(predict, payload=b"\xc1")) == "INVALID"
    assert code(ask(predict, {})) == "INVALID"
    assert code(ask("task/reach/rpc/report", {"trials": []})) == "INVALID"
    assert code(ask("task/reach/rpc/report", {"trials": [make_trial(0, cost=1.01)]})) == "INVALID"
    assert code(ask("task/reach/rpc/samples", {"limit": 0})) == "INVALID"
    assert code(ask("task/reach/rpc/explain", {"state": [0.1, 0.2]})) == "NO_SAMPLES"
    assert code(ask("task/reach/admin/refit")) == "NO_SAMPLES"
    assert code(ask("task/reach/admin/recost", {"ids": [bytes(16)], "costs": [0.1]})) == "INVALID"
    assert code(ask("task/reach/admin/configure", {"changes": {"seed": 1}})) == "INVALID"


def test_a_task_may_refuse_states_far_from_its_samples(ask: Ask, make_trial: MakeTrial, reach: dict[str, Any]) -> None:
    ask("rpc/create_task", {**reach, "name": "careful", "novel": "refuse", "novelty_limit": 0.5})
    ask("task/careful/rpc/report", {"trials": [make_trial(0, state=[0.1, 0.0], cost=0.0)], "wait": True})
    assert ask("task/careful/rpc/predict", {"states": [0.1, 0.0]})["active"] == 1
    assert code(ask("task/careful/rpc/predict", {"states": [0.9, 0.9]})) == "NOVEL_STATE"


@pytest.mark.parametrize("verb", ["rpc/*", "task/reach/rpc/*", "task/*/rpc/status"])
def test_a_key_with_a_wildcard_is_answered_with_an_error(ask: Ask, verb: str) -> None:
    assert code(ask(verb)) in ("UNSUPPORTED", "UNKNOWN_TASK", "INVALID")


def mutations(rng: np.random.Generator, valid: list[bytes]) -> bytes:
    """Hostile bytes: noise, or a valid message with bytes changed, cut, repeated or wrapped."""
    if rng.random() < 0.3:
        return rng.bytes(int(rng.integers(0, 400)))
    data = bytearray(valid[rng.integers(len(valid))])
    for _ in range(int(rng.integers(1, 6))):
        data[rng.integers(len(data))] = rng.integers(256)
    if rng.random() < 0.3:
        data = data[: rng.integers(len(data))]
    return bytes(data) if rng.random() < 0.9 else b"\x91" * 3000 + bytes(data)


HOSTILE: list[Any] = [
    {"states": {"shape": [2**40, 2**40], "dtype": "<f8", "data": b""}},
    {"states": {"shape": [-1], "dtype": "<f8", "data": b""}},
    {"states": {"shape": [2], "dtype": "O", "data": bytes(16)}},
    {"states": {"shape": [0, 2], "dtype": "<f8", "data": b""}},
    {"states": [[[[[1]]]]]},
    {"states": "0.1 0.2"},
    {"trials": [None] * 1024},
    {"trials": {"id": 1}},
    {"trials": [{"id": b"", "state": [], "goal": [], "cost": "0", "success": 1, "kind": []}]},
    {"ids": [bytes(16)] * 2, "costs": [0.1, 0.1]},
    {"changes": {"kernel": {"signal_variance": float("inf")}}},
    {"changes": []},
    {"state": None, "sample_id": 7},
    {"after": -1, "limit": 2**63},
    [],
    7,
]


def test_malformed_and_hostile_messages_get_typed_errors_and_store_nothing(ask: Ask, make_trial: MakeTrial) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(0)], "wait": True})
    tasks = set(ask("rpc/info")["tasks"])
    rng = np.random.default_rng(0)
    trial = make_trial(1, kind="evaluation")  # were one to slip through, it would be counted below
    valid = [msgpack.packb(m) for m in ({"states": [0.1, 0.2], "explore": True}, {"trials": [trial]}, {"after": 0})]
    keys = [f"task/reach/rpc/{verb}" for verb in ("predict", "report", "samples", "explain", "model", "status")]
    keys += ["rpc/create_task", "rpc/info", "task/reach/admin/recost", "task/reach/admin/configure"]
    payloads = [msgpack.packb(message) for message in HOSTILE for _ in range(3)]
    payloads += [mutations(rng, valid) for _ in range(400)]
    for number, payload in enumerate(payloads):
        reply = ask(keys[number % len(keys)], payload=payload)
        if "error" in reply:
            assert code(reply) in ("INVALID", "UNSUPPORTED", "CONFLICT"), (keys[number % len(keys)], payload, reply)
    samples = ask("task/reach/rpc/samples")["samples"]
    ours = {make_trial(0)["id"]}
    assert {sample["id"] for sample in samples if sample["kind"] == "trial"} == ours
    assert set(ask("rpc/info")["tasks"]) == tasks
    assert ask("task/reach/rpc/predict", {"states": [0.1, 0.2]})["active"] == 1
