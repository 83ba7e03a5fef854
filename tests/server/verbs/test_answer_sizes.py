"""Every answer fits into a message, however much there is to tell; else the error says what to ask instead."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import msgpack
import numpy as np
import pytest
from processes import RunningServer

from crkr.protocol import MAX_MESSAGE_BYTES, TaskSpec, Trial, most_active
from crkr.server.log import PendingReport, SqliteLog

Ask = Callable[..., dict[str, Any]]
Connect = Callable[[str], Ask]
PAGE = 1000


def axes(letter: str, count: int, width: int = 1) -> list[dict[str, Any]]:
    return [{"name": f"{letter}{n}".ljust(width, "_"), "unit": "m" * 32, "low": 0.0, "high": 1.0} for n in range(count)]


def wide(name: str, width: int = 1, **settings: Any) -> dict[str, Any]:
    return {"name": name, "state": axes("s", 256, width), "goal": axes("g", 256, width), **settings}


def small(name: str) -> dict[str, Any]:
    return {"name": name, "state": axes("s", 1), "goal": axes("g", 1)}


def wire(numbers: Any) -> dict[str, Any]:
    array = np.asarray(numbers, dtype="<f8")
    return {"shape": list(array.shape), "dtype": "<f8", "data": array.tobytes()}


def trial(dimensions: int, **fields: Any) -> dict[str, Any]:
    numbers = wire(np.full(dimensions, 0.5))
    known = {"id": uuid4().bytes, "state": numbers, "goal": numbers, "cost": 0.1, "success": True, "kind": "trial"}
    return {**known, **fields}


def test_one_task_is_asked_for_by_its_name(ask: Ask, reach: dict[str, Any]) -> None:
    [listed] = [one for one in ask("rpc/tasks")["tasks"] if ask("task/reach/rpc/status")["task"] == one["spec"]["name"]]
    found = ask("task/reach/rpc/spec")
    assert found["spec"] == listed["spec"]
    assert (found["archived"], found["model_version"]) == (False, 1)
    ask("task/reach/admin/configure", {"changes": {"budget": 9}})
    assert ask("task/reach/rpc/spec")["spec"] == {**listed["spec"], "budget": 9}
    ask("task/reach/admin/archive")
    assert ask("task/reach/rpc/spec") == {
        "spec": {**listed["spec"], "budget": 9},
        "archived": True,
        "model_version": 3,
        "log_id": found["log_id"],
    }


def test_a_log_keeps_its_id_and_no_other_has_it(
    start_server: Callable[..., RunningServer], connect: Connect, tmp_path: Path
) -> None:
    server = start_server(data=tmp_path / "one")
    ask = connect(server.endpoint)
    for name in ("first", "second"):
        ask("rpc/create_task", small(name))
    before = {name: ask(f"task/{name}/rpc/spec")["log_id"] for name in ("first", "second")}
    server.process.terminate()
    server.process.wait()
    again = connect(start_server(data=tmp_path / "one").endpoint)
    assert {name: again(f"task/{name}/rpc/spec")["log_id"] for name in before} == before
    other = connect(start_server(data=tmp_path / "other").endpoint)
    other("rpc/create_task", small("first"))
    assert len({*before.values(), other("task/first/rpc/spec")["log_id"]}) == 3
    assert all(UUID(bytes=one) for one in before.values())


@pytest.fixture
def many(start_server: Callable[..., RunningServer], connect: Connect) -> Ask:
    """A server with one page of tasks and five tasks more."""
    ask = connect(start_server().endpoint)
    for number in range(PAGE + 5):
        ask("rpc/create_task", small(f"task-{number:04}"))
    return ask


def test_many_tasks_are_listed_in_pages_and_named_in_part(many: Ask) -> None:
    names = [f"task-{number:04}" for number in range(PAGE + 5)]
    info = many("rpc/info")
    assert (info["tasks"], info["next"], info["task_count"]) == (names[:PAGE], PAGE, PAGE + 5)
    rest = many("rpc/info", {"after": info["next"]})
    assert (rest["tasks"], rest["next"]) == (names[PAGE:], None)
    assert many("rpc/info", {"limit": 0})["tasks"] == []

    listed: list[str] = []
    after: int | None = 0
    while after is not None:
        page = many("rpc/tasks", {"after": after, "limit": 400})
        assert len(page["tasks"]) <= 400
        listed += [entry["spec"]["name"] for entry in page["tasks"]]
        after = page["next"]
    assert listed == names
    assert [entry["spec"]["name"] for entry in many("rpc/tasks")["tasks"]] == names  # as version 0.1 asks
    assert many("rpc/tasks", {"after": 10**9}) == {"next": None, "tasks": []}
    for limit in (0, -1, 10**6, "all"):
        assert many("rpc/tasks", {"limit": limit})["error"]["code"] == "INVALID"
    error = many("task/nobody/rpc/spec")["error"]
    assert error["code"] == "UNKNOWN_TASK"
    assert f"{names[19]} and {PAGE - 15} more" in error["message"]
    assert len(error["message"]) < 1000


def test_a_list_that_no_message_holds_says_what_to_ask_instead(
    start_server: Callable[..., RunningServer], connect: Connect
) -> None:
    ask = connect(start_server().endpoint)
    names = [f"run-{number}" for number in range(130)]
    for name in names:
        assert ask("rpc/create_task", wide(name, 64))["created"]
    error = ask("rpc/tasks")["error"]
    assert error["code"] == "INVALID"
    assert "spec" in error["message"]
    assert "limit" in error["message"]
    assert 0 < error["details"]["most"] < error["details"]["tasks"] == 130
    listed: list[str] = []
    after: int | None = 0
    while after is not None:
        page = ask("rpc/tasks", {"after": after})
        assert len(msgpack.packb(page)) <= MAX_MESSAGE_BYTES
        listed += [entry["spec"]["name"] for entry in page["tasks"]]
        after = page["next"]
    assert listed == names
    assert ask("task/run-77/rpc/spec")["spec"]["name"] == "run-77"


def test_more_states_than_an_answer_holds_are_refused_with_how_many_it_does(ask: Ask) -> None:
    name = f"other-{uuid4()}"
    ask("rpc/create_task", wide(name))
    ask(f"task/{name}/rpc/report", {"trials": [trial(256)], "wait": True})

    def predict(count: int) -> dict[str, Any]:
        states = {"shape": [count, 256], "dtype": "<f4", "data": np.full((count, 256), 0.5, "<f4").tobytes()}
        return ask(f"task/{name}/rpc/predict", {"states": states})

    error = predict(4096)["error"]
    assert error["code"] == "INVALID"
    most = error["details"]["most"]
    assert f"at most {most} at a time" in error["message"]
    assert predict(most)["goals"]["shape"] == [most, 256]
    assert predict(most + 1)["error"]["code"] == "INVALID"


def test_pages_of_trials_end_by_their_bytes(ask: Ask) -> None:
    name = f"other-{uuid4()}"
    ask("rpc/create_task", small(name))
    worker = "\U0001f916" * 128
    for _ in range(3):
        trials = [trial(1, info={"note": "x" * 16_000}, worker=worker) for _ in range(250)]
        assert ask(f"task/{name}/rpc/report", {"trials": trials})["accepted"] == 250
    seqs: list[int] = []
    pages = 0
    after: int | None = 0
    while after is not None:
        page = ask(f"task/{name}/rpc/samples", {"after": after, "limit": 10_000})
        assert len(msgpack.packb(page)) <= MAX_MESSAGE_BYTES
        seqs += [entry["seq"] for entry in page["samples"]]
        after, pages = page["next"], pages + 1
    assert seqs == list(range(2, 752))
    assert pages > 1


def test_a_budget_whose_model_no_message_holds_is_refused(ask: Ask) -> None:
    name, most = f"other-{uuid4()}", most_active(256, 256)
    for budget, made in ((most + 1, False), (250, True)):
        reply = ask("rpc/create_task", wide(name, budget=budget))
        assert reply.get("created", False) is made
        if not made:
            assert (reply["error"]["code"], reply["error"]["details"]["most"]) == ("INVALID", most)
    reply = ask(f"task/{name}/admin/configure", {"changes": {"budget": most + 1}})
    assert (reply["error"]["code"], reply["error"]["details"]["most"]) == ("INVALID", most)
    assert ask(f"task/{name}/rpc/spec")["spec"]["budget"] == 250


def test_a_model_from_an_earlier_log_that_no_message_holds_answers_all_the_same(
    start_server: Callable[..., RunningServer], connect: Connect, tmp_path: Path
) -> None:
    spec, most = TaskSpec.from_dict(wide("early", budget=5000)), most_active(256, 256)
    rng = np.random.default_rng(5)
    log = SqliteLog(tmp_path / "data")
    log.create(spec)
    trials = tuple(
        Trial.create(spec, id=uuid4(), state=state, goal=goal, cost=0.5, success=True)
        for state, goal in rng.uniform(size=(most + 20, 2, 256))
    )
    log.append_reports([PendingReport("early", trials)])
    log.close()
    ask = connect(start_server(data=tmp_path / "data").endpoint)
    status = ask("task/early/rpc/status")
    assert "error" not in status
    active = status["active"]
    assert active > most
    error = ask("task/early/rpc/model")["error"]
    assert (error["code"], error["details"]) == ("INVALID", {"active": active, "most": most})
    assert "crkr configure" in error["message"]
    assert ask("task/early/rpc/predict", {"states": wire(np.full(256, 0.5))})["active"] == active
    changed = ask("task/early/admin/configure", {"changes": {"explore_scale": 0.5}})
    assert changed["spec"]["budget"] == 5000  # other settings may change though this one is refused now


def test_a_status_lists_some_workers_and_counts_the_rest(ask: Ask, make_trial: Any) -> None:
    ask("task/reach/rpc/report", {"trials": [{**make_trial(1), "worker": "arm-000"}], "wait": True})
    for number in range(300):
        question = {"states": [0.5, 0.0], "explore": True, "worker": f"arm-{number:03}"}
        assert "goals" in ask("task/reach/rpc/predict", question)
    status = ask("task/reach/rpc/status")
    listed = [worker["id"] for worker in status["workers"]]
    assert listed == sorted(listed)
    assert len(listed) == 256
    assert {"arm-299", "arm-044"} <= set(listed)  # those seen last
    assert status["more_workers"] == 300 - 256


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("rpc/create_task", {"name": "n" * 8_000_000}),
        ("task/reach/admin/configure", {"changes": {"c" * 8_000_000: 1}}),
        ("task/reach/admin/configure", {"changes": {f"{number:07}": 1 for number in range(500_000)}}),
        ("task/reach/rpc/report", {"trials": [{"kind": "k" * 8_000_000}]}),
    ],
)
def test_an_error_does_not_repeat_a_long_request(ask: Ask, key: str, message: dict[str, Any]) -> None:
    error = ask(key, message)["error"]
    assert error["code"] == "INVALID"
    assert len(msgpack.packb(error)) < 20_000
