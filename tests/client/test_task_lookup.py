"""A task found by its name: with one question where the server has the verb for it, from the list where it has not."""

import asyncio
from collections.abc import Callable
from typing import Any
from uuid import UUID

import pytest

from crkr.client import AsyncClient, Client
from crkr.client.client import TaskSummary
from crkr.client.commands.status import named_tasks
from crkr.protocol import Internal, Invalid, TaskSpec, Unavailable, UnknownTask, unpack

UNSUPPORTED = {"code": "UNSUPPORTED", "message": "verb 'spec' is not offered here"}
DENIED = "silence"  # which is how access control says no


def spec(name: str) -> TaskSpec:
    axis = {"name": "x", "low": 0.0, "high": 1.0}
    return TaskSpec.from_dict({"name": name, "state": [axis], "goal": [axis]})


def entry(name: str) -> dict[str, Any]:
    return {"spec": spec(name).to_dict(), "samples": 3, "active": 2, "model_version": 4, "archived": name == "old"}


@pytest.fixture
def talk(make_peer: Callable[..., Any]) -> Callable[..., Any]:
    """A peer whose answer to each verb is given, as a value or as a function of the message."""

    def start(**answers: Any) -> Any:
        def answer(number: int) -> object:
            key, payload, _ = peer.queries[number]
            given = answers[key.rpartition("/")[2]]
            return given(unpack(payload)) if callable(given) else given

        peer = make_peer(answer)
        return peer

    return start


def verbs(peer: Any) -> list[str]:
    return [key.rpartition("/")[2] for key, _, _ in peer.queries]


def pages(*names: str, size: int = 2) -> Callable[[dict[str, Any]], object]:
    """A server's list in pages of at most `size`."""

    def page(asked: dict[str, Any]) -> object:
        after = asked.get("after", 0)
        end = after + min(size, asked["limit"])
        return {"tasks": [entry(name) for name in names[after:end]], "next": end if end < len(names) else None}

    return page


def test_one_question_finds_a_task(talk: Callable[..., Any]) -> None:
    peer = talk(spec={**entry("throw"), "log_id": bytes(16)})
    with Client(peer.endpoint) as client:
        task = client.task("throw")
        assert task.spec == spec("throw")
        assert task.spec == spec("throw")
    assert [key for key, _, _ in peer.queries] == ["crkr/@v1/task/throw/rpc/spec"]


@pytest.mark.parametrize("refusal", [Exception(UNSUPPORTED), DENIED])
def test_an_earlier_server_and_an_earlier_access_control_are_asked_for_the_list(
    talk: Callable[..., Any], refusal: object
) -> None:
    peer = talk(spec=refusal, tasks={"tasks": [entry("old"), entry("throw")]})
    with Client(peer.endpoint) as client:
        assert client.task("throw").spec == spec("throw")
        with pytest.raises(UnknownTask, match="it has: old, throw; crkr create"):
            _ = client.task("toss").spec
    assert verbs(peer) == ["spec", "tasks"] * 2


def test_a_list_in_pages_is_read_up_to_the_task(talk: Callable[..., Any]) -> None:
    peer = talk(spec=DENIED, tasks=pages("a", "b", "c", "throw", "e", "f", "g"))
    with Client(peer.endpoint) as client:
        assert client.task("throw").spec == spec("throw")
    assert verbs(peer) == ["spec", "tasks", "tasks"]


def test_all_tasks_are_listed_page_by_page(talk: Callable[..., Any]) -> None:
    peer = talk(tasks=pages("a", "b", "c", "old", "e"))

    async def awaited() -> list[TaskSummary]:
        async with AsyncClient(peer.endpoint) as other:
            return [one async for one in other.iter_tasks()]

    with Client(peer.endpoint) as client:
        listed = client.tasks()
        assert list(client.iter_tasks()) == listed
    assert asyncio.run(awaited()) == listed
    assert [one["spec"].name for one in listed] == ["a", "b", "c", "old", "e"]
    assert [one["archived"] for one in listed] == [False, False, False, True, False]
    assert verbs(peer) == ["tasks"] * 9


@pytest.mark.parametrize("following", [0, -1, "b", True])
def test_pages_that_do_not_go_on_are_a_fault_of_the_server(talk: Callable[..., Any], following: object) -> None:
    peer = talk(tasks={"tasks": [entry("a")], "next": following})
    with Client(peer.endpoint) as client, pytest.raises(Internal, match="answer to tasks cannot be read"):
        client.tasks()


def test_a_look_up_by_way_of_the_list_has_one_deadline(talk: Callable[..., Any]) -> None:
    peer = talk(spec=Exception(UNSUPPORTED), tasks="hold")
    with Client(peer.endpoint, timeout_s=1000.0) as client:
        with pytest.raises(Unavailable) as caught:
            client.task("throw").predict([0.5], timeout_s=0.4)
        assert caught.value.details["key"].endswith("tasks")
        assert caught.value.details["tried_s"] < 30.0


def test_what_is_wrong_with_the_question_is_not_asked_of_the_list(talk: Callable[..., Any]) -> None:
    peer = talk(spec=Exception({"code": "INVALID", "message": "no"}))
    with Client(peer.endpoint) as client, pytest.raises(Invalid, match="no"):
        _ = client.task("throw").spec
    assert verbs(peer) == ["spec"]


@pytest.mark.parametrize("answer", [{}, {"spec": 3}, {"spec": {"name": "throw"}}])
def test_an_answer_without_a_specification_is_a_fault_of_the_server(talk: Callable[..., Any], answer: object) -> None:
    peer = talk(spec=answer)
    with Client(peer.endpoint) as client, pytest.raises(Internal, match="answer to spec cannot be read"):
        _ = client.task("throw").spec


def test_which_server_it_is_is_asked_without_the_names_of_its_tasks(talk: Callable[..., Any]) -> None:
    peer = talk(info={"server_id": bytes(16)})
    with Client(peer.endpoint) as client:
        assert client.server_id() == UUID(int=0)
    assert unpack(peer.queries[0][1]) == {"limit": 0}


def test_people_are_told_the_first_names_and_how_many_more_there_are() -> None:
    names = [f"task-{number}" for number in range(1000)]
    assert named_tasks({"tasks": names, "task_count": 2000}) == f"{', '.join(names[:20])} and 1980 more: crkr tasks"
    assert named_tasks({"tasks": names[:3]}) == "task-0, task-1, task-2"  # as a server of version 0.1 tells
    assert named_tasks({"tasks": []}) == "none yet"
