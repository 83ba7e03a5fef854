"""Questions that are answered together fail apart, and long ones are not answered on the intake's thread."""

from typing import Any, final

import msgpack
import numpy as np
import pytest
import zenoh

from crkr.learner import Model
from crkr.protocol import Prediction, TaskSpec, Trial, array_to_wire, pack, task_key
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.metrics.durations import Latencies
from crkr.server.queries.request import Request
from crkr.server.session import open_session
from crkr.server.verbs.predict import Predictor
from crkr.server.workers import Workers

PATIENCE_S = 20.0


@final
class Panic(BaseException):
    """As a binding raises it."""


@final
class Defective:
    """A model whose predictions fail by a defect, and which is like another one otherwise."""

    def __init__(self, model: Model, error: BaseException) -> None:
        self._model, self._error = model, error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._model, name)

    def predict(self, *_: object) -> Prediction:
        raise self._error


def answers(predictor: Predictor, names: list[str], state: list[float], port: int, plain: Any) -> list[str]:
    """Asks all at once, one state of each named task; "ok", or the code of the error; "left" for what it leaves."""
    endpoint = f"tcp/127.0.0.1:{port}"
    with open_session(endpoint, None) as session:
        queries = session.declare_queryable(task_key("*", "*"), zenoh.handlers.FifoChannel(100), complete=True)
        asking, waiting, requests = plain(endpoint), [], []
        for name in names:
            message = pack({"states": array_to_wire(np.array(state)), "trial_ids": [bytes(16)], "explore": True})
            key, channel = task_key(name, "predict"), zenoh.handlers.FifoChannel
            waiting.append(asking.get(key, channel(1), payload=message, timeout=PATIENCE_S))
            requests.append(Request(queries.recv(), Latencies()))
        left = predictor.answer(requests)
        for request in left:
            request.reply({"left": True})
        found = []
        for replies in waiting:
            reply = replies.recv()
            if reply.ok is None:
                found.append(msgpack.unpackb(reply.err.payload.to_bytes())["code"])
            else:
                found.append("left" if "left" in msgpack.unpackb(reply.ok.payload.to_bytes()) else "ok")
        return found


def learned(spec: dict[str, Any], count: int) -> ServedTask:
    task, rng = ServedTask(TaskSpec.from_dict(spec)), np.random.default_rng(0)
    created = task.created
    trials = [
        Trial.from_wire(
            {
                "id": rng.bytes(16),
                "state": rng.uniform(0, 1, len(created.state)).tolist(),
                "goal": rng.uniform(-1, 1, len(created.goal)).tolist(),
                "cost": 0.5,
                "success": True,
                "kind": "trial",
                **({"outcome": rng.normal(size=len(created.outcome)).tolist()} if created.outcome else {}),
            },
            created,
        )
        for _ in range(count)
    ]
    task.learner.apply_trials(range(2, count + 2), trials)
    task.publish()
    return task


@pytest.mark.parametrize("error", [ValueError("!"), Panic("!"), MemoryError()], ids=lambda error: type(error).__name__)
def test_a_defect_in_one_task_fails_that_tasks_questions_alone(
    error: BaseException, free_port: int, plain: Any, reach: dict[str, Any]
) -> None:
    tasks = Tasks()
    for name in ("calm", "faulty"):
        tasks.add(learned({**reach, "name": name}, 3))
    faulty: Any = tasks.get("faulty")
    faulty.model = Defective(faulty.model, error)
    asked = ["faulty", "calm", "faulty", "calm", "nobody"]
    found = answers(Predictor(tasks, Workers()), asked, [0.5, 0.0], free_port, plain)
    assert found == ["INTERNAL", "ok", "INTERNAL", "ok", "UNKNOWN_TASK"]


@pytest.mark.parametrize(("neighbours", "iterations", "expected"), [(60, 2, "ok"), (600, 100, "left")])
def test_a_guided_question_with_much_to_fit_is_left_for_the_slow_lane(
    neighbours: int, iterations: int, expected: str, free_port: int, plain: Any, reach: dict[str, Any]
) -> None:
    exploration = {"type": "outcome", "neighbours": neighbours, "iterations": iterations, "min_trials": 690}
    spec = {**reach, "outcome": [{"name": "miss", "tolerance": 0.05}], "exploration": exploration}
    tasks = Tasks()
    tasks.add(learned(spec, 700))
    assert answers(Predictor(tasks, Workers()), ["reach"], [0.5, 0.0], free_port, plain) == [expected]
