"""The policies that the contract is held against, and what they are told."""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol
from uuid import UUID, uuid4

from crkr.client import AsyncPolicy, AsyncTask, Policy, Task
from crkr.client.mirror import Mirror
from crkr.learner import Learner
from crkr.protocol import (
    Explanation,
    Prediction,
    Receipt,
    TaskSpec,
    TrialFields,
)
from crkr.protocol.earlier_python import Unpack

Fields = dict[str, Any]


class LearnedPolicy(Policy, Protocol):
    """A policy with what the suite looks at and changes besides."""

    @property
    def active_ids(self) -> list[UUID]: ...
    def explain(self, state: object, sample_id: UUID | None = None) -> Explanation: ...
    def recost(self, ids: Sequence[UUID], costs: object) -> object: ...
    def remove(self, ids: Sequence[UUID]) -> object: ...
    def configure(self, changes: Mapping[str, Any]) -> object: ...


class RemotePolicy:
    """A task, or its local copy, whose reports return when the model includes them."""

    def __init__(self, task: Task, mirror: Mirror | None = None) -> None:
        self.task, self.mirror, self.explain = task, mirror, task.explain
        self.recost, self.remove, self.configure = task.recost, task.remove, task.configure

    @property
    def active_ids(self) -> list[UUID]:
        ids: list[UUID] = self.task.model()["ids"]
        return ids

    def predict(self, states: object, explore: bool = False, *, trial_ids: Sequence[UUID] | None = None) -> Prediction:
        if self.mirror is None:
            return self.task.predict(states, explore, trial_ids=trial_ids)
        self.mirror.refresh()
        return self.mirror.predict(states, explore, trial_ids=trial_ids)

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        return (self.mirror or self.task).report(answer, **trial, wait=True)


class AwaitedPolicy(RemotePolicy):
    """A task whose goals are asked for, and whose trials are reported, in an event loop."""

    def __init__(self, task: Task, awaited: AsyncTask, runner: asyncio.Runner) -> None:
        super().__init__(task)
        self.awaited, self.runner = awaited, runner

    def predict(self, states: object, explore: bool = False, *, trial_ids: Sequence[UUID] | None = None) -> Prediction:
        return self.runner.run(self.awaited.predict(states, explore, trial_ids=trial_ids))

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        return self.runner.run(self.awaited.report(answer, **trial, wait=True))


def the_interfaces_are_met(learner: Learner, task: Task, mirror: Mirror, awaited: AsyncTask) -> object:
    """Read by mypy: each has the interface that it promises."""
    policies: list[Policy] = [learner, task, mirror]
    asynchronous: AsyncPolicy = awaited
    return policies, asynchronous


MakePolicy = Callable[..., LearnedPolicy]
BOUNDS = ((-1, 0, 0), (2, 1, 9))


def specification(**settings: Any) -> TaskSpec:
    return TaskSpec.from_dict(
        {
            "name": f"throw-{uuid4()}",
            "state": [{"name": "x", "low": 0, "high": 2}, {"name": "y", "low": -1, "high": 1}],
            "goal": [{"name": name, "low": low, "high": high} for name, low, high in zip("ghi", *BOUNDS, strict=True)],
            "seed": 11,
            **settings,
        }
    )


REFUSED: list[tuple[str, dict[str, Any]]] = [
    ("predict", {"states": [1.0]}),
    ("predict", {"states": [1.0, float("nan")]}),
    ("predict", {"states": [[1.0, 0.0], [1.0]]}),
    ("predict", {"states": [1.0, 0.0], "trial_ids": [uuid4(), uuid4()]}),
    ("report", {"goal": [2.1, 0.5, 5.0]}),
    ("report", {"goal": [0.5, 0.5]}),
    ("report", {"state": [1.0, float("inf")]}),
    ("report", {"cost": 1.01}),
    ("report", {"cost": None}),
    ("report", {"success": None}),
    ("report", {"kind": "wish"}),
    ("report", {"outcome": [1.0]}),
    ("report", {"info": {"a": object()}}),
    ("explain", {"state": [[1.0, 0.0]]}),
    ("explain", {"state": [1.0, 0.0], "sample_id": UUID(int=404)}),
    ("recost", {"ids": [UUID(int=404)], "costs": [0.1]}),
    ("remove", {"ids": [UUID(int=404)]}),
    ("configure", {"changes": {"seed": 3}}),
    ("configure", {"changes": {"budget": 0}}),
]
