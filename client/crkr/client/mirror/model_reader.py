"""Fetches a task's model when the server has a new one, and refuses a model that cannot be the task's."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol, final
from uuid import UUID

import numpy as np

from crkr.client.checks import answer_to
from crkr.client.network.subscription import TOPICS, Subscription
from crkr.client.rpc import Rpc
from crkr.learner import Model
from crkr.protocol import Array, Conflict, Invalid, Receipt

__all__ = ["ModelReader", "ModelSource"]


class ModelSource(Protocol):
    """The part of `Task` that a mirror uses."""

    @property
    def name(self) -> str:
        """The task's name."""

    @property
    def report(self) -> Callable[..., Receipt]:
        """`Task.report`."""

    def model(self, known_version: int | None = None, *, timeout_s: float | None = None) -> dict[str, Any]:
        """As `Task.model`."""

    def subscribe(
        self, topics: Sequence[str] = TOPICS, capacity: int = 4096, *, timeout_s: float | None = None
    ) -> Subscription:
        """As `Task.subscribe`."""


@final
class ModelReader:
    """Asks for the model; used by one thread at a time.

    Args:
        task: The task to copy.
        rpc: Asks which server answers.
        check_bounds: Raises `Invalid` where a first copy's bounds of goals are not the task's.
    """

    def __init__(self, task: ModelSource, rpc: Rpc, check_bounds: Callable[[Array, Array], None]) -> None:
        self._task, self._rpc, self._check_bounds = task, rpc, check_bounds
        self._server: UUID | None = None

    def fetch(self, known: Model | None, timeout_s: float | None) -> tuple[Model, float]:
        """The server's model (the known one where it still is), and when it was asked [s, monotonic].

        Another server may have learned something else up to the same version, so it is asked for the whole model. The
        server's id comes first: where the server changes between the two questions, the next refresh sees it.

        Raises:
            Unavailable: No answer by the deadline.
            UnknownTask: The server has no such task.
            Conflict: The task has other states or goals than the known model.
            Internal: The model cannot answer with goals that may be tried.
        """
        asked = time.monotonic()
        deadline = self._rpc.deadline(timeout_s)
        server = self._rpc.server_id(deadline - asked)
        same = known is not None and server == self._server
        reply = self._task.model(
            known.version if known is not None and same else None, timeout_s=max(deadline - time.monotonic(), 0.001)
        )
        if known is not None and same and reply.get("unchanged") is True:
            return known, asked
        with answer_to("model"):
            model = Model.from_wire(reply)
        if known is not None and not _alike(known, model):
            raise Conflict(
                f"the server now has another task {self._task.name!r}, with other states or goals; the local copy "
                "stays as it was: make a new mirror"
            )
        with answer_to("model"):
            _check(model)
            if known is None:
                self._check_bounds(model.parameters.low, model.parameters.high)
        self._server = server
        return model, asked


def _check(model: Model) -> None:
    """Raises `Invalid` for a model with numbers that are not finite or goals outside the bounds."""
    own, regression = model.parameters, model.regression
    arrays = [own.prior, own.scales, own.low, own.high, *([] if regression is None else [regression.W])]
    if not all(np.isfinite(array).all() for array in arrays):
        raise Invalid("the model holds numbers that are not finite")
    if not ((model.goals >= own.low) & (model.goals <= own.high)).all():
        raise Invalid("the model holds goals outside its bounds")


def _alike(one: Model, other: Model) -> bool:
    """Whether states and goals have the same dimensions and bounds, which a task never changes."""
    return all(
        np.array_equal(mine, theirs)
        for mine, theirs in (
            (one.parameters.kernel.centre, other.parameters.kernel.centre),
            (one.parameters.low, other.parameters.low),
            (one.parameters.high, other.parameters.high),
        )
    )
