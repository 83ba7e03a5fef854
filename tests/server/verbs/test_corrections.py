"""Trials that are amended, and changes that are taken back: over the network, in the log and after a restart."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import msgpack
import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.client import Client, Task
from crkr.protocol import Invalid
from crkr.server.data_commands import backup, replay
from crkr.server.inspection.stored_run import StoredRun

Ask = Callable[..., dict[str, Any]]
MakeTrial = Callable[..., dict[str, Any]]
COUNT = 30
AXIS = {"low": -1.0, "high": 1.0}


@pytest.fixture
def trials(ask: Ask, make_trial: MakeTrial) -> list[dict[str, Any]]:
    """Trials that a worker reported, half of them successes."""
    made = [make_trial(number, success=bool(number % 2), worker="w") for number in range(COUNT)]
    assert ask("task/reach/rpc/report", {"trials": made, "wait": True})["accepted"] == COUNT
    return made


def sample(ask: Ask, identity: bytes) -> dict[str, Any]:
    found: dict[str, Any]
    [found] = ask("task/reach/rpc/samples", {"id": identity})["samples"]
    assert found["id"] == identity
    return found


def undo(ask: Ask, number: int, **more: Any) -> dict[str, Any]:
    return ask("task/reach/admin/undo", {"request": UUID(int=number).bytes, **more})


def test_an_amended_trial_is_handed_out_and_learned_from_as_amended(ask: Ask, trials: list[dict[str, Any]]) -> None:
    missed, hit = trials[0]["id"], trials[1]["id"]
    before = ask("task/reach/rpc/status")
    reply = ask("task/reach/admin/amend", {"ids": [missed], "success": True, "cost": 0.0, "reason": "looked again"})
    assert reply == {"changed": 1, "seq": COUNT + 2, "model_version": COUNT + 2}
    assert ask("task/reach/rpc/status")["eligible"] == before["eligible"] + 1
    assert missed in ask("task/reach/rpc/model")["ids"]
    assert (sample(ask, missed)["success"], sample(ask, missed)["cost"]) == (True, 0.0)
    ask("task/reach/admin/amend", {"ids": [missed, hit], "kind": "evaluation"})
    assert not {missed, hit} & set(ask("task/reach/rpc/model")["ids"])
    ask("task/reach/admin/amend", {"ids": [trials[3]["id"]], "learn": False})
    assert sample(ask, trials[3]["id"])["learn"] is False
    assert trials[3]["id"] not in ask("task/reach/rpc/model")["ids"]
    everything = ask("task/reach/rpc/samples")["samples"]
    assert [one["kind"] for one in everything[:3]] == ["evaluation", "evaluation", "trial"]
    assert ask("task/reach/rpc/report", {"trials": trials[:1]})["duplicates"] == 1


def test_the_same_correction_again_adds_no_event(ask: Ask, trials: list[dict[str, Any]]) -> None:
    message = {"ids": [trials[0]["id"]], "success": True, "cost": 0.25}
    first = ask("task/reach/admin/amend", message)
    assert ask("task/reach/admin/amend", message) == {**first, "changed": 0}
    assert ask("task/reach/rpc/status")["seq"] == first["seq"]


def test_what_cannot_be_amended_changes_nothing(ask: Ask, trials: list[dict[str, Any]]) -> None:
    known, unknown = trials[0]["id"], UUID(int=2**100).bytes
    ask("task/reach/admin/remove", {"ids": [known]})
    seq = ask("task/reach/rpc/status")["seq"]
    for message, says in (
        ({"ids": [trials[1]["id"], unknown], "success": True}, "no trial with this id"),
        ({"ids": [known], "success": True}, "is removed"),
        ({"ids": [trials[1]["id"]]}, "nothing to amend"),
        ({"ids": [trials[1]["id"]], "cost": 1.5}, "cost"),
        ({"ids": [trials[1]["id"]], "kind": "dance"}, "kind"),
        ({"ids": [trials[1]["id"]], "outcome": [1.0]}, "outcome"),
        ({"ids": [trials[1]["id"]], "kind": "failed", "success": True}, "cannot be a success"),
        ({"ids": [], "success": True}, "ids"),
    ):
        error = ask("task/reach/admin/amend", message)["error"]
        assert error["code"] == "INVALID"
        assert says in error["message"]
    assert ask("task/reach/rpc/status")["seq"] == seq
    assert ask("task/reach/admin/amend", {"ids": [known], "restore": True})["changed"] == 1
    assert "removed" not in sample(ask, known)


def test_a_trial_amended_twice_is_what_the_later_said(ask: Ask, trials: list[dict[str, Any]]) -> None:
    one = trials[3]["id"]
    ask("task/reach/admin/amend", {"ids": [one], "success": False})
    ask("task/reach/admin/amend", {"ids": [one], "cost": 0.5})
    ask("task/reach/admin/recost", {"ids": [one], "costs": [0.75]})
    assert (sample(ask, one)["success"], sample(ask, one)["cost"]) == (False, 0.75)
    ask("task/reach/admin/remove", {"ids": [one]})
    assert sample(ask, one)["removed"] is True


def test_undoing_goes_one_step_further_back_each_time(
    ask: Ask, trials: list[dict[str, Any]], make_trial: MakeTrial
) -> None:
    mine, other = make_trial(500), trials[4]["id"]
    by_hand = ask("task/reach/rpc/report", {"trials": [mine], "wait": True})["seqs"][0]
    ask("task/reach/admin/remove", {"ids": [other]})
    ask("task/reach/admin/recost", {"ids": [mine["id"]], "costs": [0.5]})
    ask("task/reach/admin/amend", {"ids": [mine["id"], trials[5]["id"]], "success": False})
    states = ask("task/reach/rpc/predict", {"states": [[0.5, 0.0]]})
    steps = [undo(ask, number) for number in range(4)]
    assert [(step["undone"], step["undone_seq"] - by_hand) for step in steps] == [
        ("amend", 3), ("recost", 2), ("remove", 1), ("trial", 0),
    ]  # fmt: skip
    assert [len(step["ids"]) for step in steps] == [2, 1, 1, 1]
    assert sample(ask, mine["id"])["removed"] is True
    assert sample(ask, mine["id"])["cost"] == mine["cost"]
    assert sample(ask, trials[5]["id"])["success"] is True
    assert "removed" not in sample(ask, other)
    assert ask("task/reach/rpc/status")["eligible"] == COUNT // 2
    error = undo(ask, 9)["error"]
    assert (error["code"], "nothing to undo" in error["message"]) == ("INVALID", True)
    assert undo(ask, 10, worker="w")["ids"] == [trials[-1]["id"]]
    assert ask("task/reach/rpc/predict", {"states": [[0.5, 0.0]]})["means"] != states["means"]


def test_a_repeated_request_to_undo_is_carried_out_once(ask: Ask, trials: list[dict[str, Any]]) -> None:
    for cost in (0.1, 0.2):
        ask("task/reach/admin/amend", {"ids": [trials[0]["id"]], "cost": cost})
    first = undo(ask, 1)
    assert undo(ask, 1) == first
    assert sample(ask, trials[0]["id"])["cost"] == 0.1


def test_samples_are_read_backwards_page_by_page(ask: Ask, trials: list[dict[str, Any]]) -> None:
    page = ask("task/reach/rpc/samples", {"last": 4})
    assert [one["id"] for one in page["samples"]] == [one["id"] for one in trials[:-5:-1]]
    assert page["backwards"] is True
    rest = ask("task/reach/rpc/samples", {"last": 100, "before": page["next"]})
    assert [one["id"] for one in rest["samples"]] == [one["id"] for one in trials[-5::-1]]
    assert rest["next"] is None
    wanted = [trials[7]["id"], trials[2]["id"]]
    assert [one["id"] for one in ask("task/reach/rpc/samples", {"id": wanted})["samples"]] == wanted
    assert ask("task/reach/rpc/samples", {"id": [UUID(int=2**99).bytes]})["error"]["code"] == "INVALID"


def specification(name: str, **more: Any) -> dict[str, Any]:
    axes = {"state": [{"name": "x", **AXIS}], "goal": [{"name": "g", **AXIS}]}
    return {"name": name, **axes, "outcome": [{"name": "miss", "tolerance": 0.1}], **more}


def teach(task: Task, count: int = 60) -> list[UUID]:
    rng = np.random.default_rng(1)
    states, goals = rng.uniform(-1, 1, (2, count, 1))
    success = (np.abs(states - goals) < 0.5)[:, 0]
    trials: dict[str, Any] = {"state": states, "goal": goals, "outcome": goals - states}
    task.report(**trials, cost=np.abs(goals - states)[:, 0] / 2, success=success.tolist(), wait=True)
    return [one.trial.id for one in task.iter_samples()]


def test_the_log_alone_says_what_was_amended(start_server: Callable[..., Any], tmp_path: Path) -> None:
    server = start_server()
    draws = [UUID(int=number + 1) for number in range(20)]
    states = np.linspace(-1, 1, 20)[:, None]

    def seen(endpoint: str) -> tuple[list[Any], list[np.ndarray[Any, Any]]]:
        with Client(endpoint, timeout_s=30.0) as client:
            task = client.task("amended")
            answer = task.predict(states, True, trial_ids=draws)
            model, copied = task.model(), task.mirror()
            with copied:
                mirrored = copied.predict(states, True, trial_ids=draws)
            stored = [msgpack.packb(one.to_wire(), default=repr) for one in task.iter_samples()]
            numbers = [answer.goals, answer.means, mirrored.means, mirrored.goals]
            return [model["ids"], model["version"], stored, task.status()["eligible"]], numbers

    with Client(server.endpoint, timeout_s=30.0) as client:
        task = client.create_task(specification("amended", budget=20))
        with task.mirror() as mirror:
            ids = teach(task)
            mirror.refresh()
            before = mirror.predict(states).means
            task.amend(ids[:30], success=False, cost=1.0, outcome=[np.nan], reason="the camera was off")
            task.amend(ids[30:34], success=True, cost=0.0, outcome=[0.0])
            task.undo()
            task.amend(ids[40:44], kind="demonstration")
            mirror.refresh()
            assert np.abs(mirror.predict(states).means - before).max() > 1e-3
    first, numbers = seen(server.endpoint)
    server.process.kill()
    server.process.wait()
    again = start_server(data=server.data)
    second, numbers_again = seen(again.endpoint)
    assert first == second
    for ours, theirs in zip(numbers, numbers_again, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-9)

    def run(command: Any, *words: str) -> str:
        app = Typer()
        app.command()(command)
        result = CliRunner().invoke(app, list(words), catch_exceptions=False)
        assert result.exit_code == 0
        return result.output

    assert "log and model agree" in run(replay, str(server.data))
    (tmp_path / "copy").mkdir()
    run(backup, str(server.data), str(tmp_path / "copy" / "crkr.sqlite3"))
    assert "log and model agree" in run(replay, str(tmp_path / "copy"))
    stored = StoredRun(tmp_path / "copy", "amended")
    [(trials, facts)] = list(stored.pages(1000))
    stored.close()
    assert [msgpack.packb(one.to_wire(), default=repr) for one in trials] == first[2]
    assert facts["eligible"] == first[3]


def test_a_label_brings_its_cost_where_a_task_learns_from_labels(shared_endpoint: str) -> None:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        task = client.create_task(specification("labels-amended", cost="label", exploration={"type": "gaussian"}))
        task.report(state=[0.1], goal=[0.1], success=False)
        [stored] = task.trials(last=1)
        assert stored.trial.cost == 0.9
        task.amend(stored.trial.id, success=True)
        [amended] = task.trials(id=stored.trial.id)
        assert (amended.trial.success, amended.trial.cost) == (True, 0.1)
        task.report(state=[0.3], goal=[0.9], cost=0.95, success=False)
        assert [one.trial.cost for one in task.trials(worst=5)] == [0.95, 0.1]
        with pytest.raises(Invalid, match="one of last"):
            task.trials(last=1, worst=1)
