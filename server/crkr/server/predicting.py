"""Answers `predict` from the model at hand: what waits together is answered together, and nothing waits to fill up.

How long a prediction takes is known beforehand from the number of states b and of active samples m: the m^2 numbers of
the factor are read once, and each state costs m^2 operations more. Where outcomes guide the goals, each state is
compared with the observed trials besides. So what asks for much is told from what asks for little by work, not by
bytes.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, final

import numpy as np

from crkr.learner import Model
from crkr.protocol import (
    Array,
    CrkrError,
    Invalid,
    NovelState,
    Prediction,
    PredictRequest,
    most_states_answered,
    pack,
    random_ids,
    unpack,
)
from crkr.protocol.predict_bytes import Question, packed_rows, read_question, state_bytes
from crkr.server.request import Request
from crkr.server.tasks import ServedTask, Tasks
from crkr.server.workers import Workers

__all__ = ["Predictor"]

_AT_ONCE_US: Final = 1000.0  # of work, after which others have their turn
_STATE_US: Final = 3.0  # the work of a state, apart from the samples
_SQUARE_US: Final = 30e-6  # for each state and each of m^2
_PASS_US: Final = 120e-6  # for each of m^2, whatever the number of states
_GUIDED_US: Final = 300.0  # for each state whose goal outcomes guide
_TRIAL_US: Final = 0.016  # for each such state and each trial that it is compared with
_LEAST: Final = 8  # states at a time; with fewer, reading the factor again and again would be most of the work
_LONGEST: Final = 128  # name of a worker


@final
class Predictor:
    """The work of the predict lanes; any thread may call it."""

    def __init__(self, tasks: Tasks, workers: Workers) -> None:
        self._tasks, self._workers = tasks, workers

    def answer(self, requests: list[Request]) -> list[Request]:
        """Answers requests, with a prediction or an error.

        Patient ones are all answered. Of the others, one that needs more than a millisecond is made patient and left;
        and those behind a millisecond's work are left as they are.

        Returns:
            Those left, in the same order.
        """
        together: defaultdict[tuple[str, bool], list[tuple[Request, Question]]] = defaultdict(list)
        left: list[Request] = []
        work = 0.0
        for place, request in enumerate(requests):
            if work > _AT_ONCE_US and not request.patient:
                left += requests[place:]
                break
            try:
                task = self._tasks.get(request.task)
                payload, cost = request.payload(), _Cost.of(task.model)
                question, message = read_question(payload, task.dimensions), None
                if question is None:
                    message = unpack(payload)
                    question = _question(message, task.dimensions)
                needed = cost.us(1 if message is None else _states(message))
                if needed > _AT_ONCE_US and not request.patient:
                    request.patient = True
                    left.append(request)
                    continue
                work += needed
                if question is None:
                    self._answer_alone(request, task)
                    continue
                alike = together[request.task, question.explore]
                if alike:
                    work -= cost.once_us  # the factor is read once for all of them
                alike.append((request, question))
            except Exception as error:  # this one's fault alone; it is answered and the others go on
                request.fail_unexpectedly(error)
        for (name, explore), questions in together.items():
            self._answer_together(self._tasks.get(name), explore, questions)
        return left

    def _answer_together(self, task: ServedTask, explore: bool, questions: list[tuple[Request, Question]]) -> None:
        """One call of the model for all; where one of them is refused, each is asked alone."""
        started = time.perf_counter_ns()
        states = np.frombuffer(b"".join([question.state for _, question in questions]), "<f8")
        asked = states.reshape(len(questions), task.dimensions) if len(questions) > 1 else states
        ids = [question.trial_id for _, question in questions]
        try:
            answer = _predicted(task.model, asked, explore, ids if explore else None)
        except CrkrError:
            for request, _ in questions:
                try:
                    self._answer_alone(request, task)
                except Exception as error:
                    request.fail_unexpectedly(error)
            return
        rows = packed_rows(answer, ids, (time.perf_counter_ns() - started) // 1000)
        for (request, question), row in zip(questions, rows, strict=True):
            request.reply_packed(row)
            if explore and question.worker:
                self._workers.asked(task.name, question.worker, (question.trial_id,))

    def _answer_alone(self, request: Request, task: ServedTask) -> None:
        """Any form of request, checked in full."""
        question = PredictRequest.from_wire(unpack(request.payload()), task.dimensions)
        _refuse_long_answer(task, question.count)
        started = time.perf_counter_ns()
        ids = [one.bytes for one in question.trial_ids] or random_ids(question.count)
        answer = _predicted(task.model, question.states, question.explore, ids)
        reply = answer.to_wire()
        reply["compute_us"] = (time.perf_counter_ns() - started) // 1000
        request.reply_packed(pack(reply))
        if question.explore and question.worker is not None:
            self._workers.asked(task.name, question.worker, ids)


class _Cost(NamedTuple):
    """About how long predictions by a model take, what every question costs left out.

    Attributes:
        once_us: For any number of states [us].
        state_us: For each state [us].
    """

    once_us: float
    state_us: float

    @classmethod
    def of(cls, model: Model) -> _Cost:
        square, searched = model.active**2, model.explorer.searched
        guided = _GUIDED_US + _TRIAL_US * searched if searched else 0.0
        return cls(_PASS_US * square, _STATE_US + _SQUARE_US * square + guided)

    def us(self, count: int) -> float:
        """For so many states [us]."""
        return self.once_us + count * self.state_us


def _refuse_long_answer(task: ServedTask, count: int) -> None:
    """Raises `Invalid` where the predictions of so many states are more than a message holds."""
    spec = task.created
    most = most_states_answered(len(spec.goal), len(spec.outcome) if spec.exploration.type == "outcome" else 0)
    if count > most:
        raise Invalid(
            f"the answer for {count} states at once would be too large a message; ask task {task.name!r} about at "
            f"most {most} at a time",
            details={"field": "states", "most": most},
        )


def _states(message: Mapping[str, Any]) -> int:
    """How many states a request seems to ask about; whether it is in order is found out when it is answered."""
    states = message.get("states")
    if type(states) is dict:
        shape = states.get("shape")
        return max(1, shape[0]) if type(shape) is list and len(shape) == 2 and type(shape[0]) is int else 1
    return len(states) if type(states) is list and states and type(states[0]) is list else 1


def _question(message: Mapping[str, Any], dimensions: int) -> Question | None:
    """A request about one state that others can be answered together with; None: it needs a full look."""
    explore, worker, given = message.get("explore", False), message.get("worker"), message.get("trial_ids")
    state = state_bytes(message, dimensions)
    if state is None or type(explore) is not bool:
        return None
    if worker is not None and not (type(worker) is str and len(worker) <= _LONGEST):
        return None
    if given is None:
        given = random_ids(1)
    one = type(given) is list and len(given) == 1 and type(given[0]) is bytes and len(given[0]) == 16
    return Question(state, explore, given[0], worker) if one else None


def _predicted(model: Model, states: Array, explore: bool, ids: Sequence[bytes] | None) -> Prediction:
    """A few states at a time: no other thread of Python runs while the factor is solved for them."""
    if states.ndim == 1:
        return model.predict(states, explore, ids)
    cost = _Cost.of(model)
    most = max(_LEAST, int((_AT_ONCE_US - cost.once_us) / cost.state_us))
    if len(states) <= most:
        return model.predict(states, explore, ids)
    starts = range(0, len(states), most)
    try:
        parts = [
            model.predict(states[start : start + most], explore, None if ids is None else ids[start : start + most])
            for start in starts
        ]
    except NovelState:
        return model.predict(states, explore, ids)  # whose error names the most novel of all
    return Prediction.joined(parts)
