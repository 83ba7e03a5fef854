"""Tasks that are renamed or deleted: their names are free, their data stay until they are purged."""

from collections.abc import Callable
from typing import Any
from uuid import UUID

import pytest
from processes import Processes
from typer import Typer
from typer.testing import CliRunner

from crkr.client import Client, Task
from crkr.protocol import Conflict, Invalid, UnknownTask
from crkr.server.data_commands import purge, replay

Ask = Callable[..., dict[str, Any]]
AXIS = {"low": -1.0, "high": 1.0}


def specification(name: str, **more: Any) -> dict[str, Any]:
    return {"name": name, "state": [{"name": "x", **AXIS}], "goal": [{"name": "g", **AXIS}], **more}


def teach(task: Task, count: int = 5) -> None:
    for number in range(count):
        task.report(state=[number / 9], goal=[number / 9], cost=0.1, success=True, id=UUID(int=number + 1), wait=True)


def run(command: Callable[..., None], *words: str, status: int = 0) -> str:
    app = Typer()
    app.command()(command)
    result = CliRunner().invoke(app, list(words))
    assert result.exit_code == status, f"{result.output}{result.exception!r}"
    return result.output


def test_a_renamed_task_goes_on_under_its_new_name(shared_endpoint: str, processes: Processes) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        teach(client.create_task(specification("renamed-before", budget=7)))
        client.create_task(specification("renamed-next"))
        order = [entry["spec"].name for entry in client.tasks()]
        before = client.task("renamed-before").predict([0.3]).goal
        reply = client.task("renamed-before").rename("renamed-after")
        assert (reply["name"], reply["seq"]) == ("renamed-after", 7)
        task = client.task("renamed-after")
        assert (task.spec.name, task.spec.budget) == ("renamed-after", 7)
        assert task.predict([0.3]).goal == before
        teach(task, 6)  # five of them are known
        assert task.status()["samples"]["trial"] == 6
        task.configure({"budget": 8})
        assert (client.task("renamed-after").spec.name, task.spec.budget) == ("renamed-after", 8)
        with pytest.raises(UnknownTask, match="renamed-before"):
            client.task("renamed-before").status()
        names = {"renamed-before": "renamed-after"}
        assert [entry["spec"].name for entry in client.tasks()] == [names.get(name, name) for name in order]
        with pytest.raises(Conflict, match="already"):
            task.rename("renamed-next")
        with pytest.raises(Invalid, match="task name"):
            task.rename("No Name")
        with task.announce("worker-1"):
            processes.wait_until(lambda: any(entry["id"] == "worker-1" for entry in task.status()["workers"]))
            with pytest.raises(Conflict, match="'worker-1'"):
                task.rename("renamed-again")
            with pytest.raises(Conflict, match="'worker-1'"):
                task.delete()


def test_what_is_asked_again_after_a_lost_answer_is_answered_as_the_first_time(
    start_server: Callable[..., Any], connect: Callable[[str], Ask]
) -> None:
    server = start_server()
    ask = connect(server.endpoint)
    first, second = ({"request": number * bytes([1]) + bytes(16 - number)} for number in (1, 2))
    for name in ("before", "gone"):
        ask("rpc/create_task", specification(name))
    renamed = ask("task/before/admin/rename", {"name": "after", **first})
    deleted = ask("task/gone/admin/delete", first)
    assert (renamed["name"], deleted["deleted"]) == ("after", True)
    ask("rpc/create_task", specification("gone", budget=7))

    def repeated() -> None:
        assert ask("task/before/admin/rename", {"name": "after", **first}) == renamed
        assert ask("task/gone/admin/delete", first) == deleted
        assert ask("task/gone/rpc/status")["seq"] == 1  # the new task of that name is another's
        for verb, message in (("rename", {"name": "after", **second}), ("delete", first), ("delete", {})):
            assert ask(f"task/before/admin/{verb}", message)["error"]["code"] == "UNKNOWN_TASK"
        assert ask("task/gone/admin/delete", {"request": b"short"})["error"]["code"] == "INVALID"

    repeated()
    server.process.kill()
    server.process.wait(5)
    ask = connect(start_server(data=server.data, port=server.port).endpoint)
    repeated()
    assert ask("task/gone/admin/delete", second)["deleted"] is True


def test_a_deleted_task_frees_its_name_and_stays_until_it_is_purged(start_server: Callable[..., Any]) -> None:
    server = start_server()
    with Client(server.endpoint, timeout_s=20.0) as client:
        task = client.create_task(specification("gone"))
        teach(task)
        assert task.delete()["deleted"] is True
        with pytest.raises(UnknownTask):
            task.status()
        assert client.tasks() == []
        again = client.create_task(specification("gone", budget=3))
        assert again.created is True
        teach(again, 2)
        other = client.create_task(specification("other"))
        teach(other, 3)
        other.rename("kept")
        assert client.task("gone").status()["samples"]["trial"] == 2

    def restart() -> Any:
        server.process.terminate()
        assert server.process.wait(60) == 0
        return start_server(data=server.data, port=server.port)

    server = restart()
    with Client(server.endpoint, timeout_s=20.0) as client:
        assert [entry["spec"].name for entry in client.tasks()] == ["gone", "kept"]
        assert client.task("kept").status()["samples"]["trial"] == 3
        teach(client.task("kept"), 4)
    server.process.terminate()
    assert server.process.wait(60) == 0
    output = run(replay, str(server.data))
    assert "deleted/gone/" in output
    assert "3 tasks" in output
    [kept] = run(purge, str(server.data)).splitlines()
    run(purge, str(server.data), "--restore", kept, status=1)  # the name is taken
    run(purge, str(server.data), "--restore", kept, "--yes", status=2)
    assert run(purge, str(server.data), "--yes") == f"{kept} is removed\n"
    assert "no deleted tasks" in run(purge, str(server.data))
    assert "2 tasks" in run(replay, str(server.data))
    server = start_server(data=server.data, port=server.port)
    with Client(server.endpoint, timeout_s=20.0) as client:
        assert client.task("gone").status()["samples"]["trial"] == 2
        client.task("gone").delete()
    server.process.terminate()
    assert server.process.wait(60) == 0
    run(purge, str(server.data), "--restore", "kept", status=1)
    assert run(purge, str(server.data), "--restore", "gone") == "gone is back\n"
    server = start_server(data=server.data, port=server.port)
    with Client(server.endpoint, timeout_s=20.0) as client:
        task = client.task("gone")
        assert (task.spec.budget, task.status()["samples"]["trial"]) == (3, 2)
        teach(task, 3)
