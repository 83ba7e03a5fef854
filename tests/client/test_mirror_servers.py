"""A local copy of a policy beside servers that end, come back with other data, or hand over what cannot be read."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from processes import Processes
from putt_task import IDS, PROBES, assert_alike, practise, specification

from crkr.client import Client
from crkr.learner import Learner
from crkr.protocol import (
    Conflict,
    Internal,
    TaskSpec,
    Unavailable,
    pack,
    unpack,
)

PATIENCE_S = 20.0


def test_it_answers_while_there_is_no_server_and_catches_up_with_the_next_one(
    start_server: Callable[..., Any], free_port: int, processes: Processes
) -> None:
    first = start_server(port=free_port)
    with Client(first.endpoint) as client:
        task = client.create_task(specification())
        practise(task, 20, 1)
        with task.mirror(every_s=0.1) as mirror, task.mirror(max_age_s=2.0) as cautious:
            before = mirror.predict(PROBES, True, trial_ids=IDS)
            first.process.kill()
            first.process.wait()
            age_s = mirror.age_s
            processes.wait_until(lambda: mirror.fault is not None)
            assert isinstance(mirror.fault, Unavailable)
            assert mirror.age_s > age_s
            np.testing.assert_array_equal(mirror.predict(PROBES, True, trial_ids=IDS).goals, before.goals)
            processes.wait_until(lambda: cautious.age_s > 2.0)
            with pytest.raises(Unavailable, match="more than 2 s"):
                cautious.predict(PROBES)

            start_server(port=free_port)
            seq = practise(task, 5, 2)
            for one in (mirror, cautious):
                one.wait_for(seq, PATIENCE_S)
                assert one.fault is None
                assert_alike(one.predict(PROBES, True, trial_ids=IDS), task.predict(PROBES, True, trial_ids=IDS))


def test_it_takes_over_what_a_server_with_other_data_learned(
    start_server: Callable[..., Any], free_port: int, tmp_path: Path
) -> None:
    """Up to the same log position, and up to an earlier one, as from a backup."""
    fixed = specification()
    server = start_server(port=free_port, data=tmp_path / "0")
    with Client(server.endpoint) as client:
        task = client.create_task(fixed)
        version = practise(task, 10, 0)
        with task.mirror() as mirror:
            for number, count in enumerate((10, 6), start=1):
                server.process.kill()
                server.process.wait()
                server = start_server(port=free_port, data=tmp_path / str(number))
                client.create_task(fixed)
                assert practise(task, count, number) == version - (10 - count)
                mirror.refresh(PATIENCE_S)
                assert_alike(mirror.predict(PROBES, True, trial_ids=IDS), task.predict(PROBES, True, trial_ids=IDS))
                assert mirror.fault is None


def learned(spec: TaskSpec, cost: float = 0.1) -> dict[str, Any]:
    """A model as a server hands it over."""
    learner = Learner(spec)
    d, p = len(spec.state), len(spec.goal)
    learner.report(state=np.linspace(0, 1, 9 * d).reshape(9, d), goal=np.zeros((9, p)), cost=cost, success=True)
    return unpack(pack(learner.model.to_wire()))


def served(make_peer: Callable[..., Any], models: list[dict[str, Any]], servers: list[int]) -> Any:
    """A peer that hands over these models, one after the other, as servers with these ids."""
    asked = {"model": 0, "info": 0}

    def answer(number: int) -> object:
        verb = peer.queries[number][0].rpartition("/")[2]
        asked[verb] += 1
        if verb == "info":
            return {"server_id": UUID(int=servers[min(asked[verb], len(servers)) - 1]).bytes}
        model = models[min(asked[verb], len(models)) - 1]
        known = unpack(peer.queries[number][1]).get("known_version")
        return {"unchanged": True, "version": known} if known == model["version"] else model

    peer = make_peer(answer)
    return peer


def test_a_server_that_changes_between_two_questions_is_noticed_by_the_next(make_peer: Callable[..., Any]) -> None:
    spec = specification()
    first, second = learned(spec), learned(spec, cost=0.7)
    assert first["version"] == second["version"]
    peer = served(make_peer, [first, second], [1, 1, 2])
    with Client(peer.endpoint) as client, client.task("putt").mirror(every_s=1000.0, pause_s=1000.0) as mirror:
        assert not mirror.refresh()
        assert mirror.refresh()
        np.testing.assert_array_equal(mirror.model.costs, 0.7)
        assert not mirror.refresh()


@pytest.mark.parametrize("what", ["states", "goals", "bounds", "box"])
def test_another_task_of_the_same_name_is_not_taken_over(make_peer: Callable[..., Any], what: str) -> None:
    spec = specification()
    fields = spec.to_dict()
    if what == "states":
        fields["state"].append({"name": "z", "low": 0, "high": 1})
    elif what == "goals":
        fields["goal"].pop()
    elif what == "bounds":
        fields["goal"][0]["high"] = 2
    else:
        fields["state"][0]["high"] = 2
    peer = served(make_peer, [learned(spec), learned(TaskSpec.from_dict(fields))], [1, 2])
    with Client(peer.endpoint) as client, client.task("putt").mirror(every_s=1000.0, pause_s=1000.0) as mirror:
        before = mirror.predict(PROBES)
        with pytest.raises(Conflict, match="another task"):
            mirror.refresh()
        assert isinstance(mirror.fault, Conflict)
        np.testing.assert_array_equal(mirror.predict(PROBES).goals, before.goals)
        assert "fault=CONFLICT" in repr(mirror)


def test_a_model_that_cannot_be_read_leaves_the_copy_as_it_was(make_peer: Callable[..., Any]) -> None:
    model = learned(specification())
    bad = {**model, "costs": unpack(pack({"costs": np.zeros(8)}))["costs"]}
    peer = served(make_peer, [model, bad], [1, 2])
    with Client(peer.endpoint) as client, client.task("putt").mirror(every_s=1000.0, pause_s=1000.0) as mirror:
        before = mirror.predict(PROBES)
        with pytest.raises(Internal, match="costs"):
            mirror.refresh()
        assert isinstance(mirror.fault, Internal)
        np.testing.assert_array_equal(mirror.predict(PROBES).goals, before.goals)
