"""A task that measured outcomes guide, over the network and over a restart."""

from collections.abc import Callable
from typing import Any, Protocol
from uuid import UUID, uuid4

import msgpack
import numpy as np
import pytest
import zenoh
from processes import Processes

Ask = Callable[..., dict[str, Any]]
Numbers = Callable[[Any], np.ndarray[Any, Any]]
PREFIX = "crkr/@v1/"
STATES = np.random.default_rng(2).uniform(-1, 1, (40, 2))
IDS = [UUID(int=number + 1).bytes for number in range(40)]


class Server(Protocol):
    """What `start_server` gives."""

    endpoint: str
    process: Any


def specification(name: str) -> dict[str, Any]:
    return {
        "name": name,
        "state": [{"name": axis, "low": -1, "high": 1} for axis in "xy"],
        "goal": [{"name": axis, "low": -3, "high": 3, "scale": 1.0} for axis in "gh"],
        "outcome": [
            {"name": "side", "unit": "m", "target": 0.2, "tolerance": 0.05, "group": "hit"},
            {"name": "far", "unit": "m", "tolerance": 0.05, "group": "landing"},
        ],
        "exploration": {"type": "outcome", "gate": 10},
    }


def trials(count: int, seed: int = 0) -> list[dict[str, Any]]:
    """A world in which side = x + g and far = y + 2 h; what lands is seen in two of three trials."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        state, goal = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
        landed = float(state[1] + 2 * goal[1]) if rng.uniform() < 0.7 else None
        made.append(
            {
                "id": rng.bytes(16),
                "state": state.tolist(),
                "goal": goal.tolist(),
                "cost": float(rng.uniform()),
                "success": bool(rng.uniform() < 0.3),
                "kind": "trial",
                "outcome": [float(state[0] + goal[0]), landed],
            }
        )
    return made


@pytest.fixture
def aim(shared_endpoint: str, connect: Callable[[str], Ask]) -> tuple[Ask, str]:
    """A task that has seen 300 trials: how to ask the server, and the task's name."""
    ask, name = connect(shared_endpoint), f"reach-aim-{uuid4()}"
    assert ask("rpc/create_task", specification(name))["created"] is True
    ask(f"task/{name}/rpc/report", {"trials": trials(300), "wait": True})
    return ask, name


def test_a_goal_is_corrected_where_its_mean_would_miss(aim: tuple[Ask, str], numbers: Numbers) -> None:
    ask, name = aim
    policies = set()
    for state in STATES:
        answer = ask(f"task/{name}/rpc/predict", {"states": state.tolist()})
        mean, goal = numbers(answer["means"]), numbers(answer["goals"])
        misses = [np.abs([state[0] + g[0] - 0.2, state[1] + 2 * g[1]]).max() for g in (mean, goal)]
        policies.add(answer["policy"])
        if answer["policy"] == "mean":
            np.testing.assert_array_equal(goal, mean)
            assert misses[0] < 0.55  # ten tolerances, and what a line is off
        else:
            assert misses[0] > 0.45
            assert misses[1] < 0.06
        hit = [state[0] + goal[0], state[1] + 2 * goal[1]]
        np.testing.assert_allclose(numbers(answer["predicted_outcome"]), hit, atol=0.03)
        assert (numbers(answer["predicted_outcome_sd"]) < 0.05).all()
    assert policies == {"mean", "corrected"}


def test_questions_answered_together_get_what_each_would_get_alone(
    aim: tuple[Ask, str], plain: Callable[[str], zenoh.Session], shared_endpoint: str, numbers: Numbers
) -> None:
    ask, name = aim
    session = plain(shared_endpoint)
    for explore in (False, True):
        waiting = []
        for state, one in zip(STATES, IDS, strict=True):
            wire = {"shape": [2], "dtype": "<f8", "data": state.tobytes()}
            payload = msgpack.packb({"states": wire, "explore": explore, "trial_ids": [one]})
            waiting.append(
                session.get(
                    f"{PREFIX}task/{name}/rpc/predict", zenoh.handlers.FifoChannel(2), payload=payload, timeout=10.0
                )
            )
        replies = []
        for replied in waiting:
            found = replied.recv()
            assert found.ok is not None
            replies.append(msgpack.unpackb(found.ok.payload.to_bytes()))
        batch = ask(f"task/{name}/rpc/predict", {"states": STATES.tolist(), "explore": explore, "trial_ids": IDS})
        assert batch["policy"] == ("explore" if explore else "corrected")
        for row, reply in enumerate(replies):
            message = {"states": STATES[row].tolist(), "explore": explore, "trial_ids": [IDS[row]]}
            alone = ask(f"task/{name}/rpc/predict", message)
            assert reply["policy"] == alone["policy"]
            for field in ("goals", "predicted_outcome", "predicted_outcome_sd"):
                np.testing.assert_allclose(numbers(reply[field]), numbers(alone[field]), rtol=0, atol=1e-9)
                np.testing.assert_allclose(numbers(batch[field])[row], numbers(alone[field]), rtol=0, atol=1e-9)
        assert len({reply["policy"] for reply in replies}) == (1 if explore else 2)


def test_a_restarted_server_is_guided_as_before(
    start_server: Callable[..., Server], connect: Callable[[str], Ask], numbers: Numbers
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    ask("rpc/create_task", specification("aim"))
    told = trials(200, 3)
    for first in range(0, 200, 25):
        ask("task/aim/rpc/report", {"trials": told[first : first + 25]})
    judged = [{**one, "kind": "evaluation", "outcome": [9.0, 9.0]} for one in trials(20, 4)]
    ask("task/aim/rpc/report", {"trials": judged})
    ask("task/aim/admin/remove", {"ids": [one["id"] for one in told[50:60]]})
    ask("task/aim/rpc/report", {"trials": trials(1, 5), "wait": True})

    def answers(ask: Ask) -> list[np.ndarray[Any, Any]]:
        found = []
        for explore in (False, True):
            message = {"states": STATES.tolist(), "explore": explore, "trial_ids": IDS}
            reply = ask("task/aim/rpc/predict", message)
            assert reply["policy"] == ("explore" if explore else "corrected")
            found += [numbers(reply[name]) for name in ("goals", "means", "predicted_outcome", "predicted_outcome_sd")]
        return found

    before = answers(ask)
    server.process.kill()
    server.process.wait(timeout=60)
    for old, new in zip(before, answers(connect(start_server().endpoint)), strict=True):
        np.testing.assert_allclose(new, old, rtol=0, atol=1e-9)


def test_questions_of_little_work_overtake_guided_ones_about_many_states(
    aim: tuple[Ask, str], ask: Ask, plain: Callable[[str], zenoh.Session], shared_endpoint: str, processes: Processes
) -> None:
    first, name = aim
    ask("task/reach/rpc/report", {"trials": [{**trials(1)[0], "goal": [0.0] * 3, "success": True, "outcome": None}]})
    states = np.random.default_rng(6).uniform(-1, 1, (60, 2))
    wire = {"shape": [60, 2], "dtype": "<f8", "data": states.tobytes()}
    greedy, answers = plain(shared_endpoint), list[zenoh.Reply]()
    for _ in range(60):
        payload = msgpack.packb({"states": wire})
        greedy.get(f"{PREFIX}task/{name}/rpc/predict", answers.append, payload=payload, timeout=60.0)
    for _ in range(5):
        assert ask("task/reach/rpc/predict", {"states": [0.5, 0.0]})["active"] == 1
    assert first(f"task/{name}/rpc/status")["queues"]["predict"]["waiting"] > 0
    assert len(answers) < 60
    processes.wait_until(lambda: len(answers) == 60)
    assert all(answer.ok is not None for answer in answers)


def test_what_a_restart_leaves_for_later_holds_up_no_other_task(
    start_server: Callable[..., Server],
    connect: Callable[[str], Ask],
    plain: Callable[[str], zenoh.Session],
    processes: Processes,
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    for name, count in (("aim", 300), ("other", 20)):
        ask("rpc/create_task", specification(name))
        ask(f"task/{name}/rpc/report", {"trials": trials(count), "wait": True})
    asked = {"states": [0.5, 0.0], "trial_ids": IDS[:1]}
    before = ask("task/aim/rpc/predict", asked)
    server.process.kill()
    server.process.wait(timeout=60)
    endpoint = start_server().endpoint
    ask, answers = connect(endpoint), list[zenoh.Reply]()
    ask("task/other/rpc/predict", asked)
    plain(endpoint).get(f"{PREFIX}task/aim/rpc/predict", answers.append, payload=msgpack.packb(asked), timeout=60.0)
    for _ in range(5):
        ask("task/other/rpc/predict", asked)
    assert answers == []
    processes.wait_until(lambda: len(answers) == 1)
    [answer] = answers
    assert answer.ok is not None
    after = msgpack.unpackb(answer.ok.payload.to_bytes())
    assert {**after, "compute_us": 0} == {**before, "compute_us": 0}
