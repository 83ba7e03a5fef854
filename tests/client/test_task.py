"""A task over a real server: what the client adds to the bare protocol."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.client import Client, Task
from crkr.protocol import Conflict, Invalid, NoSamples, TaskSpec, Unavailable, UnknownTask, demonstration_id

THROW: dict[str, Any] = {
    "name": "throw",
    "state": [{"name": "distance", "unit": "m", "low": 0, "high": 4}, {"name": "height", "low": 0, "high": 1}],
    "goal": [{"name": "speed", "unit": "m/s", "low": 0, "high": 8}],
}


@pytest.fixture(scope="module")
def client(shared_endpoint: str) -> Iterator[Client]:
    with Client(shared_endpoint, timeout_s=30.0) as client:
        client.wait_until_ready(60.0)
        yield client


@pytest.fixture
def spec() -> dict[str, Any]:
    return {**THROW, "name": f"throw-{uuid4()}"}


@pytest.fixture
def task(client: Client, spec: dict[str, Any]) -> Task:
    return client.create_task(spec)


def test_a_server_introduces_itself_with_an_id_and_its_tasks(client: Client, task: Task) -> None:
    info = client.info()
    assert info["protocol"] == 1
    assert isinstance(info["server_id"], UUID)
    assert task.name in info["tasks"]


def test_a_task_is_made_once_and_found_again(client: Client, task: Task, spec: dict[str, Any]) -> None:
    assert task.created is True
    again = client.create_task(TaskSpec.from_dict({**spec, "description": "in other words"}))
    assert again.created is False
    with pytest.raises(Conflict) as caught:
        client.create_task({**spec, "budget": 9})
    assert caught.value.details["fields"] == {"budget": [250, 9]}
    [summary] = [entry for entry in client.tasks() if entry["spec"].name == task.name]
    assert summary == {"spec": task.spec, "samples": 0, "active": 0, "model_version": 1, "archived": False}


def test_the_specification_is_the_one_in_force(client: Client, task: Task, spec: dict[str, Any]) -> None:
    assert task.spec == TaskSpec.from_dict(spec)
    task.configure({"budget": 7, "kernel": {"linear_weight": 0.5}})
    assert task.spec == TaskSpec.from_dict(spec).with_changes({"budget": 7, "kernel": {"linear_weight": 0.5}})
    assert client.task(task.name).spec.budget == 7


def test_an_unknown_task_is_told_apart_from_an_impossible_name(client: Client, task: Task) -> None:
    with pytest.raises(UnknownTask, match="throw"):
        client.task("trow").predict([1, 1])
    with pytest.raises(UnknownTask):
        client.task("trow").status()
    with pytest.raises(Invalid, match="task name"):
        client.task("No Such/Task")


def test_the_loop_of_the_readme(task: Task) -> None:
    with pytest.raises(NoSamples):
        task.predict([1.0, 0.5])
    task.report(state=[1.0, 0.5], goal=[3.0], cost=0.1, success=True, kind="demonstration", wait=True)
    answer = task.predict([1.2, 0.5], explore=True, worker="w")
    receipt = task.report(answer, cost=0.3, success=True, worker="w", wait=True)
    assert (receipt.accepted, receipt.duplicates, receipt.seqs) == (1, 0, (3,))
    assert task.report(answer, cost=0.3, success=True).duplicates == 1
    stored = list(task.iter_samples())
    assert [sample.seq for sample in stored] == [2, 3]
    assert stored[1].trial.id == answer.trial_id
    np.testing.assert_array_equal(stored[1].trial.goal, answer.goal)
    assert stored[1].trial.model_version == answer.model_version


def test_a_prediction_draws_once_even_if_it_is_asked_twice(task: Task) -> None:
    task.report(state=[1.0, 0.5], goal=[3.0], cost=0.1, success=True, wait=True)
    first = task.predict([[1.0, 0.5], [3.0, 0.1]], explore=True)
    second = task.predict([[1.0, 0.5], [3.0, 0.1]], explore=True, trial_ids=first.trial_ids)
    np.testing.assert_allclose(first.goals, second.goals, rtol=0, atol=1e-9)
    third = task.predict([[1.0, 0.5], [3.0, 0.1]], explore=True)
    assert not set(third.trial_ids) & set(first.trial_ids)
    assert {identifier.version for identifier in third.trial_ids} == {4}


def test_all_samples_are_paged_in_order(task: Task) -> None:
    states = np.random.default_rng(0).uniform(0, 1, (25, 2))
    ids = [demonstration_id(task.name, index) for index in range(25)]
    task.report(state=states, goal=np.ones((25, 1)), cost=0.5, success=False, id=ids)
    first, following = task.samples(limit=10)
    assert len(first) == 10
    assert following == first[-1].seq
    assert [sample.trial.id for sample in task.iter_samples()] == ids
    assert [sample.seq for sample in task.iter_samples(after=20)] == list(range(21, 27))


def test_the_model_is_sent_only_where_it_is_new(task: Task) -> None:
    task.report(state=[1.0, 0.5], goal=[3.0], cost=0.1, success=True, wait=True)
    model = task.model()
    np.testing.assert_array_equal(model["states"], [[1.0, 0.5]])
    assert [type(sample_id) for sample_id in model["ids"]] == [UUID]
    assert task.model(model["version"])["unchanged"] is True


def test_costs_are_corrected_and_trials_taken_out(task: Task) -> None:
    ids = [uuid4(), uuid4()]
    task.report(state=[[1, 0], [3, 1]], goal=[[3.0], [5.0]], cost=[0.1, 0.2], success=True, id=ids, wait=True)
    assert task.recost([ids[0]], [0.9], "camera")["changed"] == 1
    assert task.remove([ids[1]], "slip")["removed"] == 1
    first, second = task.iter_samples()
    assert (first.trial.cost, first.removed, second.removed) == (0.9, False, True)
    explanation = task.explain([1.0, 0.0], ids[0])
    assert [neighbour.id for neighbour in explanation.neighbours] == [ids[0]]
    assert explanation.sample is not None
    assert explanation.sample.active


def test_an_archived_task_answers_and_does_not_learn(task: Task) -> None:
    task.report(state=[1.0, 0.5], goal=[3.0], cost=0.1, success=True, wait=True)
    task.archive()
    assert task.predict([1.0, 0.5]).active == 1
    with pytest.raises(Invalid, match="archived"):
        task.report(state=[1.0, 0.5], goal=[3.0], cost=0.1, success=True)


def test_the_server_sees_a_worker_while_it_is_announced(task: Task) -> None:
    with task.announce("w-1"):
        while [(w["id"], w["state"]) for w in task.status()["workers"]] != [("w-1", "alive")]:
            pass  # the pytest timeout is the deadline
    while [w["state"] for w in task.status()["workers"]] != ["left"]:
        pass


@pytest.mark.parametrize("verb", ["predict", "report", "samples", "explain", "outbox"])
def test_the_first_call_of_a_task_ends_by_its_own_deadline(
    make_peer: Callable[..., Any], tmp_path: Path, verb: str
) -> None:
    """It asks for the specification too, which took the client's default before."""
    arguments: dict[str, Any] = {
        "predict": {"states": [0.0, 0.0]},
        "report": {"state": [0.0, 0.0], "goal": [1.0], "cost": 0.0, "success": True},
        "samples": {},
        "explain": {"state": [0.0, 0.0]},
        "outbox": {"path": tmp_path / "box"},
    }
    with Client(make_peer(["hold"]).endpoint, timeout_s=1000.0) as client:
        with pytest.raises(Unavailable) as caught:
            getattr(client.task("throw"), verb)(**arguments[verb], timeout_s=0.3)
        assert caught.value.details["tried_s"] < 30.0


def test_what_is_left_of_the_time_goes_to_the_call_itself(make_peer: Callable[..., Any], spec: dict[str, Any]) -> None:
    peer = make_peer([{"spec": TaskSpec.from_dict(spec).to_dict()}, "hold"])
    with Client(peer.endpoint, timeout_s=1000.0) as client:
        task = client.task(spec["name"])
        assert repr(task) == f"Task({spec['name']!r})"
        with pytest.raises(Unavailable) as caught:
            task.predict([0.0, 0.0], timeout_s=0.4)
        assert caught.value.details["key"].endswith("predict")
        assert caught.value.details["tried_s"] < 30.0
