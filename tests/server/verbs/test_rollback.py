"""A task goes back to the policy of an earlier version, and forth again; nothing is lost."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.client import Client, Task
from crkr.protocol import Invalid, TaskSpec, id_from_wire, make_trials
from crkr.server.data_commands import replay
from crkr.server.inspection.verification import verify
from crkr.server.learning.restore import FEW, relearned, restore
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import Event, PendingReport, SqliteLog, Stored
from crkr.server.verbs.admin import read_change
from crkr.server.verbs.rollback import read_rollback

AXIS = {"low": -1.0, "high": 1.0}
STATES = np.linspace(-1, 1, 15)[:, None]
DRAWS = [UUID(int=number + 1) for number in range(15)]


def specification(name: str, **more: Any) -> dict[str, Any]:
    axes = {"state": [{"name": "x", **AXIS}], "goal": [{"name": "g", **AXIS}]}
    return {"name": name, **axes, "outcome": [{"name": "miss", "tolerance": 0.1}], "budget": 20, **more}


def teach(task: Task, seed: int, count: int = 40) -> list[UUID]:
    rng = np.random.default_rng(seed)
    states, goals = rng.uniform(-1, 1, (2, count, 1))
    ids = [UUID(bytes=rng.bytes(16)) for _ in range(count)]
    success = (np.abs(states - goals) < 0.5)[:, 0].tolist()
    trials: dict[str, Any] = {"state": states, "goal": goals, "outcome": goals - states, "id": ids}
    task.report(**trials, cost=np.abs(goals - states)[:, 0] / 2, success=success, wait=True)
    return ids


def answers(task: Task) -> list[np.ndarray[Any, Any]]:
    """What the policy says, with what its outcome model says."""
    explored, best = (task.predict(STATES, explore, trial_ids=DRAWS) for explore in (True, False))
    assert explored.predicted_outcome is not None
    return [explored.goals, best.goals, best.means, best.sigmas, explored.predicted_outcome]


def same(ours: list[np.ndarray[Any, Any]], theirs: list[np.ndarray[Any, Any]]) -> bool:
    return all(np.allclose(one, other, rtol=0, atol=1e-9) for one, other in zip(ours, theirs, strict=True))


def trials(task: Task) -> list[tuple[Any, ...]]:
    return [(one.trial.id, one.trial.cost, one.trial.success, one.removed) for one in task.iter_samples()]


def test_the_policy_of_each_version_comes_back_and_survives_a_restart(start_server: Callable[..., Any]) -> None:
    server = start_server()
    with Client(server.endpoint, timeout_s=30.0) as client:
        task = client.create_task(specification("back"))
        first = teach(task, 1)
        task.recost(first[:2], [0.9, 0.8])
        early, early_trials, version = answers(task), trials(task), task.status()["model_version"]
        second = teach(task, 2)
        task.amend(first[:20], success=False, cost=1.0)
        task.recost(first[20:24], [0.0] * 4)
        task.remove(first[30:35])
        task.configure({"budget": 5, "regularisation": 0.2})
        task.refit()
        late, late_trials, newest = answers(task), trials(task), task.status()["model_version"]
        assert not same(early, late)
        with task.mirror() as mirror:
            assert task.rollback(version, "the camera was off")["to"] == version
            mirror.refresh()
            np.testing.assert_allclose(mirror.predict(STATES).means, early[2], rtol=0, atol=1e-9)
        assert same(answers(task), early)
        assert client.task("back").spec.budget == 20
        assert trials(task)[: len(early_trials)] == early_trials
        assert all(removed for *_, removed in trials(task)[len(early_trials) :])
        with pytest.raises(Invalid, match="rolled back to before trial"):
            task.amend(second[:1], success=True)
        with pytest.raises(Invalid, match="rolled back to before trial"):
            task.remove(second[:1])
        third = teach(task, 3)
        assert task.trials(last=1)[0].trial.id == third[-1]
        branch, branch_version = answers(task), task.status()["model_version"]
        with pytest.raises(Invalid, match="no version"):
            task.rollback(10**6)
        task.rollback(newest)
        assert same(answers(task), late)
        assert trials(task)[: len(late_trials)] == late_trials
        task.rollback(branch_version)
        assert same(answers(task), branch)
        task.amend(third[:1], cost=0.5)
        task.undo()
        last, last_trials = answers(task), trials(task)
    server.process.kill()
    server.process.wait()
    with Client(start_server(data=server.data).endpoint, timeout_s=30.0) as client:
        task = client.task("back")
        assert same(answers(task), last)
        assert trials(task) == last_trials
        task.rollback(version)
        assert same(answers(task), early)
    app = Typer()
    app.command()(replay)
    result = CliRunner().invoke(app, [str(server.data)], catch_exceptions=False)
    assert "log and model agree" in result.output


def test_a_rollback_stores_no_more_than_what_it_changes(tmp_path: Path) -> None:
    spec = TaskSpec.from_dict(specification("brief"))
    log = SqliteLog(tmp_path / "data")
    served = ServedTask(spec)
    served.note(log.create(spec))
    made = make_trials(spec, state=STATES, goal=STATES, outcome=0 * STATES, cost=0.5, success=True)
    [stored] = log.append_reports([PendingReport("brief", made)])
    assert isinstance(stored, Stored)
    ids = [one.id for one in made]

    def change(verb: str, message: dict[str, Any]) -> Event:
        made = read_rollback(message, served, log.reads) if verb == "rollback" else read_change(verb, message, served)
        body: Any = made.body
        if made.complete is not None:
            body = made.complete([served.corrections.present(one) for one in log.reads.trials("brief", made.ids)])
        event = log.append_event("brief", made.kind, body)
        served.note(event)
        return event

    for entry in stored.fresh:
        served.note(entry)
    change("recost", {"ids": [one.bytes for one in ids[:10]], "costs": [0.1] * 10})
    version = served.seq
    change("amend", {"ids": [one.bytes for one in ids[5:8]], "success": False})
    change("remove", {"ids": [ids[9].bytes]})
    there, again = (change("rollback", {"to": version}) for _ in range(2))
    assert sorted(map(id_from_wire, there.body["ids"])) == sorted([*ids[5:8], ids[9]])
    assert again.body["ids"] == []
    assert [one["cost"] for one in map(served.corrections.present, log.reads.trials("brief", ids[:11]))] == [
        *[0.1] * 10,
        0.5,
    ]
    assert verify(log.reads, "brief").problems == ()
    log.close()


def test_a_long_log_is_rolled_back_as_a_short_one(tmp_path: Path) -> None:
    spec = TaskSpec.from_dict(specification("long", exploration={"type": "gaussian"}))
    rng = np.random.default_rng(0)
    log = SqliteLog(tmp_path / "data")
    log.create(spec)
    for count in (FEW // 2, FEW // 2, 800):
        states, goals = rng.uniform(-1, 1, (2, count, 1))
        made = make_trials(spec, state=states, goal=goals, cost=np.abs(states - goals)[:, 0] / 2, success=True)
        log.append_reports([PendingReport("long", made)])
    to = 1 + FEW // 2
    body = {"to": to, "ids": [], "values": [], "spec": spec.to_dict(), "reason": ""}
    log.append_event("long", "rollback", body)
    states, goals = rng.uniform(-1, 1, (2, 50, 1))
    made = make_trials(spec, state=states, goal=goals, cost=np.abs(states - goals)[:, 0] / 2, success=True)
    log.append_reports([PendingReport("long", made)])
    task = restore(log.reads, "long")
    assert task.learner.eligible == FEW // 2 + 50
    before = relearned(log.reads, ServedTask(spec), to)
    assert (before.version, before.eligible) == (to, FEW // 2)
    assert verify(log.reads, "long").problems == ()
    log.close()
