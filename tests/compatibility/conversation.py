"""What a client of either version says and is told; run as a program, it prints that as one JSON value.

    python conversation.py PART ENDPOINT FILE

It uses only what version 0.1 has. Times, and ids that a server makes, are left out: all else is a function of what is
said here.
"""

import asyncio
import json
import sys
from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID

import numpy as np

from crkr.client import AsyncClient, Client, Task
from crkr.protocol import CrkrError, demonstration_id, task_id

SPEC: dict[str, Any] = {
    "name": "toss",
    "state": [{"name": "distance", "unit": "m", "low": 0, "high": 4}, {"name": "height", "low": 0, "high": 1}],
    "goal": [{"name": "speed", "unit": "m/s", "low": 0, "high": 8}, {"name": "angle", "low": -1, "high": 1}],
    "budget": 12,
    "seed": 3,
    "novel": "refuse",
}
MEASURED: dict[str, Any] = {
    **SPEC,
    "name": "measured",
    "outcome": [{"name": "miss", "unit": "m", "tolerance": 0.1}],
    "exploration": {"type": "gaussian"},
}
STATES = np.array([[0.4, 0.1], [1.0, 0.5], [1.6, 0.2], [2.2, 0.9], [2.8, 0.4], [3.4, 0.7]])


def goals(states: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.stack([2.0 * states[:, 0], states[:, 1] - 0.5], axis=1)


def ids(task: str, what: str, count: int) -> list[UUID]:
    return [task_id(task, f"{what}/{number}") for number in range(count)]


def refusal(call: Callable[[], Any]) -> str:
    try:
        call()
    except CrkrError as error:
        return error.code
    return "none"


def teach(task: Task) -> Iterator[Any]:
    """Demonstrations and trials, one of them twice, one in conflict, one out of bounds."""
    shown = [demonstration_id(task.name, number) for number in range(len(STATES))]
    known: dict[str, Any] = {"state": STATES, "goal": goals(STATES), "cost": [0.1] * 6, "success": [True] * 6}
    told = [
        task.report(**known, kind="demonstration", id=shown, info={"by": "hand", "deep": [1, {"two": 2.5}]}, wait=True)
        for _ in range(2)
    ]
    yield [[one.accepted, one.duplicates, one.seqs, one.model_version] for one in told]
    yield refusal(lambda: task.report(**{**known, "cost": [0.2] * 6}, kind="demonstration", id=shown))
    yield refusal(lambda: task.report(state=STATES[0], goal=[99.0, 0.0], cost=0.1, success=True))


def try_goals(task: Task) -> Iterator[Any]:
    """Predictions of one state and of many, drawn and not; what was drawn is reported under its id."""
    yield [np.round(value, 9).tolist() for value in _numbers(task.predict(np.array([1.2, 0.3])))]
    batch = ids(task.name, "batch", 5)
    answer = task.predict(STATES[:5] + 0.05, explore=True, trial_ids=batch, worker="arm")
    again = task.predict(STATES[:5] + 0.05, explore=True, trial_ids=batch, worker="arm")
    yield [np.round(value, 9).tolist() for value in _numbers(answer)]
    yield [np.array_equal(answer.goals, again.goals), answer.trial_ids == batch, answer.policy, answer.active]
    receipt = task.report(answer, cost=[0.1 * n for n in range(5)], success=[True, True, False, True, True], wait=True)
    yield [receipt.accepted, receipt.seqs, receipt.model_version]
    yield refusal(lambda: task.predict(np.array([400.0, 0.0])))
    yield refusal(lambda: task.predict([1.0]))


def _numbers(answer: Any) -> tuple[Any, ...]:
    return answer.goals, answer.means, answer.sigmas, answer.novelty


def look(task: Task) -> Iterator[Any]:
    """What can be read of a task."""
    status = task.status()
    yield {name: plain(status[name]) for name in ("samples", "eligible", "active", "seq", "model_version", "archived")}
    yield [[worker["id"], worker["open_trials"]] for worker in status["workers"]]
    model = task.model()
    yield [model["version"], len(model["ids"]), np.round(model["goals"], 9).tolist(), task.model(model["version"])]
    why = task.explain(np.array([1.2, 0.3]), demonstration_id(task.name, 1))
    yield [[str(one.id), round(one.weight, 9)] for one in why.neighbours]
    page, following = task.samples(0, 4)
    yield [following, [[one.seq, str(one.trial.id), one.trial.info] for one in page]]
    yield [[one.seq, one.trial.cost, one.removed] for one in task.iter_samples()]


def change(task: Task) -> Iterator[Any]:
    """All that an administrator may do; archiving is the end."""
    shown = [demonstration_id(task.name, number) for number in range(2)]
    yield [task.recost(shown, [0.3, 0.4], "measured again")[name] for name in ("changed", "seq", "model_version")]
    yield [task.remove(shown[:1], "a mistake")[name] for name in ("removed", "seq", "model_version")]
    yield plain(task.configure({"budget": 9, "kernel": {"signal_variance": 1.5}})["spec"])
    yield task.spec.budget
    yield sorted(task.refit())
    yield refusal(lambda: task.configure({"seed": 4}))
    yield refusal(lambda: task.remove([UUID(int=9)]))


def aside(client: Client, task: Task, file: str) -> Iterator[Any]:
    """The copy of the policy, reports by way of a file, notices, signs of life, and the same awaited."""
    state = np.array([1.2, 0.3])
    with task.mirror() as mirror, task.subscribe(("model",)) as notices, task.announce("arm"):
        yield bool(np.allclose(mirror.predict(state).goal, task.predict(state).goal, rtol=0, atol=1e-9))
        with task.outbox(file) as outbox:
            outbox.report(state=state, goal=[2.4, -0.2], cost=0.2, success=True, id=ids(task.name, "box", 1))
            outbox.flush(30.0)
        seq = task.status()["seq"]
        while (notice := notices.receive(30.0)) is not None and notice[1]["version"] < seq:
            pass  # of what was changed before
        yield None if notice is None else [notice[0], notice[1]["version"]]
        mirror.wait_for(seq, 30.0)
        yield bool(np.allclose(mirror.predict(state).goal, task.predict(state).goal, rtol=0, atol=1e-9))

    async def awaited() -> list[Any]:
        async with AsyncClient(client.endpoint, timeout_s=30.0) as other:
            found = other.task(task.name)
            answer = await found.predict(state)
            return [len(await other.tasks()), bool(np.array_equal(answer.goal, task.predict(state).goal))]

    yield asyncio.run(awaited())


def converse(client: Client, file: str) -> Iterator[Any]:
    """Everything, on a server that has no tasks yet."""
    info = client.wait_until_ready(60.0)
    yield [info["protocol"], info["limits"], info["tasks"], isinstance(info["server_id"], UUID)]
    yield [refusal(lambda: client.task("toss").spec), refusal(lambda: client.task("toss").predict([1.0, 0.0]))]
    yield [client.create_task(spec).created for spec in (SPEC, MEASURED, SPEC)]
    yield refusal(lambda: client.create_task({**SPEC, "budget": 7}))
    yield [client.info()["tasks"], [plain(entry["spec"].to_dict()) for entry in client.tasks()]]
    for name in ("toss", "measured"):
        task = client.task(name)
        yield [plain(task.spec.to_dict()), refusal(lambda task=task: task.predict(STATES[0]))]  # type: ignore[misc]  # a default keeps each task
        yield list(teach(task))
        yield list(try_goals(task))
        yield list(look(task))
        yield list(change(task))
        yield list(look(task))
        yield list(aside(client, task, f"{file}-{name}"))
    task = client.task("toss")
    yield task.archive()["archived"]
    yield refusal(lambda: task.report(state=STATES[0], goal=[1.0, 0.0], cost=0.1, success=True))
    yield [entry["archived"] for entry in client.tasks()]


def leave(client: Client, file: str) -> Iterator[Any]:
    """A log with something of everything, and a file with reports that no server has."""
    client.wait_until_ready(60.0)
    for spec in (SPEC, MEASURED):
        task = client.create_task(spec)
        yield [list(teach(task)), list(try_goals(task)), list(change(task))]
    client.task("measured").archive()
    task = client.task("toss")
    outbox = task.outbox(file)
    outbox.flush(30.0)
    client.close()  # what comes now stays in the file
    outbox.report(state=STATES, goal=goals(STATES), cost=0.1, success=True, id=ids("toss", "box", 6))
    outbox.close()


def find(client: Client, file: str) -> Iterator[Any]:
    """What `leave` left, read without changing it."""
    client.wait_until_ready(60.0)
    for name in ("toss", "measured"):
        task = client.task(name)
        yield [plain(task.spec.to_dict()), list(look(task))]
        yield [np.round(value, 9).tolist() for value in _numbers(task.predict(STATES[:3]))]
    yield [entry["archived"] for entry in client.tasks()]


def deliver(client: Client, file: str) -> Iterator[Any]:
    """The reports of the file that `leave` left."""
    client.wait_until_ready(60.0)
    task = client.task("toss")
    with task.outbox(file) as outbox:
        yield outbox.pending
        outbox.flush(30.0)
        yield [outbox.pending, len(outbox.refused())]
    stored = {one.trial.id for one in task.iter_samples()}
    yield stored >= set(ids("toss", "box", 6))


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=lambda one: one.tolist() if hasattr(one, "tolist") else str(one)))


if __name__ == "__main__":
    part, endpoint, file = sys.argv[1:]
    with Client(endpoint, timeout_s=30.0) as client:
        told = list({"converse": converse, "leave": leave, "find": find, "deliver": deliver}[part](client, file))
    sys.stdout.write(json.dumps(plain(told)) + "\n")
