"""A task that asks for much work holds up none that asks for little."""

from collections.abc import Callable
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
import zenoh
from processes import Processes

from crkr.protocol import task_key
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.fair_queue import RoundRobin
from crkr.server.queries.request import Request
from crkr.server.session import open_session
from crkr.server.verbs.predict import _states

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
Numbers = Callable[[Any], np.ndarray[Any, Any]]
ACTIVE = 600
STATES = (
    230  # 230 of 2 numbers are fewer bytes than are answered at once, and a large model needs milliseconds for them
)
QUESTIONS = 200


@pytest.fixture
def large(connect: Callable[[str], Ask], shared_endpoint: str, reach: dict[str, Any], make_trial: MakeTrial) -> str:
    """The name of a task with many active samples."""
    ask, name = connect(shared_endpoint), "reach-large"
    ask("rpc/create_task", {**reach, "name": name, "budget": ACTIVE})
    trials = [make_trial(number) for number in range(ACTIVE)]
    for first in range(0, ACTIVE, 200):
        ask(f"task/{name}/rpc/report", {"trials": trials[first : first + 200], "wait": True})
    assert ask(f"task/{name}/rpc/status")["active"] == ACTIVE
    return name


def asked_states() -> np.ndarray[Any, Any]:
    return np.random.default_rng(5).uniform([0, -1], [1, 1], (STATES, 2))


def packed(states: np.ndarray[Any, Any]) -> bytes:
    wire = {"shape": list(states.shape), "dtype": "<f8", "data": states.tobytes()}
    payload: bytes = msgpack.packb({"states": wire})
    return payload


def test_questions_of_little_work_overtake_those_of_much(
    ask: Ask,
    large: str,
    make_trial: MakeTrial,
    plain: Callable[[str], zenoh.Session],
    shared_endpoint: str,
    processes: Processes,
) -> None:
    ask("task/reach/rpc/report", {"trials": [make_trial(1)], "wait": True})
    payload = packed(asked_states())
    assert len(payload) <= 4096
    greedy = plain(shared_endpoint)
    answers: list[zenoh.Reply] = []
    for _ in range(QUESTIONS):
        greedy.get(f"crkr/@v1/task/{large}/rpc/predict", answers.append, payload=payload, timeout=60.0)
    for _ in range(10):
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1
    assert ask("task/reach/rpc/status")["queues"]["predict"]["waiting"] > 0
    assert len(answers) < QUESTIONS
    processes.wait_until(lambda: len(answers) == QUESTIONS)
    assert all(answer.ok is not None for answer in answers)


def test_many_states_are_answered_as_if_each_had_been_asked_about_alone(ask: Ask, large: str, numbers: Numbers) -> None:
    states = asked_states()
    reply = ask(f"task/{large}/rpc/predict", payload=packed(states))
    assert len(set(reply["trial_ids"])) == STATES
    for row in (0, 1, STATES // 2, STATES - 1):
        alone = ask(f"task/{large}/rpc/predict", {"states": states[row].tolist()})
        for name in ("goals", "means", "sigmas", "novelty"):
            np.testing.assert_allclose(numbers(reply[name])[row], numbers(alone[name]), rtol=1e-9, atol=1e-12)


def test_ids_decide_the_goals_to_try_among_many_states_too(ask: Ask, large: str, numbers: Numbers) -> None:
    states = asked_states()
    ids = [UUID(int=number + 1).bytes for number in range(STATES)]
    wire = {"shape": list(states.shape), "dtype": "<f8", "data": states.tobytes()}
    reply = ask(f"task/{large}/rpc/predict", {"states": wire, "explore": True, "trial_ids": ids})
    assert reply["trial_ids"] == ids
    alone = ask(f"task/{large}/rpc/predict", {"states": states[-1].tolist(), "explore": True, "trial_ids": [ids[-1]]})
    np.testing.assert_allclose(numbers(reply["goals"])[-1], numbers(alone["goals"]), rtol=1e-9)


def test_the_most_novel_of_many_states_is_named(ask: Ask, large: str, numbers: Numbers) -> None:
    states = asked_states()
    states[100], states[200] = (3.0, 1.0), (1.5, 2.0)
    novelty = numbers(ask(f"task/{large}/rpc/predict", payload=packed(states))["novelty"])
    limit = float(np.sort(novelty)[-3:-1].mean())
    ask(f"task/{large}/admin/configure", {"changes": {"novel": "refuse", "novelty_limit": limit}})
    try:
        error = ask(f"task/{large}/rpc/predict", payload=packed(states))["error"]
    finally:
        ask(f"task/{large}/admin/configure", {"changes": {"novel": "predict"}})
    assert error["code"] == "NOVEL_STATE"
    assert error["details"]["index"] == int(np.argmax(novelty))


def test_tasks_take_turns_and_those_put_back_are_next(plain: Callable[[str], zenoh.Session], free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(task_key("*", "*"), zenoh.handlers.FifoChannel(64), complete=True)
        asking = plain(endpoint)
        turns = RoundRobin()
        for task in "aaaaabbc":
            asking.get(task_key(task, "predict"), zenoh.handlers.FifoChannel(1), timeout=10.0)
            assert turns.add(Request(queries.recv(), Latencies()))
        batch = turns.take(4)
        assert [request.task for request in batch] == ["a", "b", "c", "a"]
        turns.put_back(batch[2:])
        assert len(turns) == 6
        again = turns.take(3)
        assert again[:2] == batch[2:]
        assert again[2].task == "b"
        assert [request.task for request in turns.take(10)] == ["a"] * 3
        assert len(turns) == 0
        for request in batch:
            request.reply({})


@pytest.mark.parametrize("rows", [0, -1, -(2**62)])
def test_no_question_counts_as_less_than_one_state(rows: int) -> None:
    """Or the work of those behind it would seem to be none."""
    assert _states({"states": {"shape": [rows, 2], "dtype": "<f8", "data": b""}}) == 1
