"""Answers `predict` from the current model. Waiting questions are answered together; none waits for a batch to fill.

The time of a prediction follows from the numbers of states b and of active samples m: the m^2 numbers of the factor are
read once, and each state costs m^2 operations. Outcome-guided goals also compare each state with observed trials. Long
questions are answered in slices, with other requests in between.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Self, final

import numpy as np

from crkr.learner import Model
from crkr.protocol import (
    MOST_NEIGHBOURS,
    CrkrError,
    Invalid,
    NovelState,
    Prediction,
    PredictRequest,
    TaskSpec,
    most_states_answered,
    pack,
    random_ids,
    unpack,
)
from crkr.protocol.messages.predict_bytes import Question, packed_rows, read_question, state_bytes
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.queries.request import Request
from crkr.server.workers import Workers

__all__ = ["Predictor"]

_AT_ONCE_US: Final = 1500.0  # of work in a turn
_STATE_US: Final = 3.0  # a state, without the samples
_SQUARE_US: Final = 30e-6  # each state, for each of m^2
_PASS_US: Final = 120e-6  # any number of states, for each of m^2
_GUIDED_US: Final = 200.0  # each state with an outcome-guided goal
_TRIAL_US: Final = 0.016  # each such state, for each trial compared
_GROUP_US: Final = 50.0  # each such state, for each group of outcomes
_FIT_US: Final = 1.7e-4  # each such group, for each of n^3 with n neighbours
_CANDIDATE_US: Final = 0.05  # each such group, for each neighbour of each candidate beyond the usual ones
_USUAL_CANDIDATES: Final = 32
_FILL_US: Final = 0.3  # any number of states while goals fill space, for each of p^2
_LEAST: Final = 8  # states per slice; with fewer, reading the factor dominates
_LONG_US: Final = 10_000.0  # of work per slice, even with fewer states
_LONGEST: Final = 128  # name of a worker


@final
class Predictor:
    """The work of the predict lanes; any thread may call it."""

    def __init__(self, tasks: Tasks, workers: Workers) -> None:
        self._tasks, self._workers = tasks, workers

    def answer(self, requests: list[Request]) -> list[Request]:
        """Answer requests with a prediction or an error, for about a millisecond.

        A request that takes longer is marked patient and left over, as are requests behind that much work.

        Returns:
            Requests left over, in order.
        """
        together: defaultdict[tuple[str, bool], list[tuple[Request, Question]]] = defaultdict(list)
        left: list[Request] = []
        work = 0.0
        for place, request in enumerate(requests):
            if work > _AT_ONCE_US:
                left += requests[place:]
                break
            try:
                task = self._tasks.get(request.task)
                payload, cost = request.payload(), _Cost.of(task, task.model)
                question, message = read_question(payload, task.dimensions), None
                if question is None:
                    message = unpack(payload)
                    question = _question(message, task.dimensions)
                needed = cost.us(1 if message is None else _states(message))
                if needed > _AT_ONCE_US or not task.model.explorer.prepare():
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
            except BaseException as error:  # fails this request only
                request.fail_unexpectedly(error)
        for (name, explore), questions in together.items():
            try:
                self._answer_together(self._tasks.get(name), explore, questions)
            except BaseException as error:  # fails these questions only
                for request, _ in questions:
                    request.fail_unexpectedly(error)
        return left

    def work(self, requests: list[Request]) -> list[Request]:
        """Work on patient requests, each for about a millisecond, and answer those that are done.

        Returns:
            Unfinished requests.
        """
        unfinished: list[Request] = []
        for request in requests:
            try:
                if request.progress is None:
                    request.progress = _Batch.begin(request, self._tasks.get(request.task))
                batch: _Batch = request.progress
                if not batch.step():
                    request.left = request.size * batch.share_left
                    unfinished.append(request)
                    continue
                self._reply(request, batch.question, batch.result(), batch.ids, batch.compute_us)
            except BaseException as error:
                request.fail_unexpectedly(error)
            request.progress = None
        return unfinished

    def _answer_together(self, task: ServedTask, explore: bool, questions: list[tuple[Request, Question]]) -> None:
        """Answer all by one call of the model; if it refuses one of them, answer each alone."""
        started = time.perf_counter_ns()
        states = np.frombuffer(b"".join([question.state for _, question in questions]), "<f8")
        asked = states.reshape(len(questions), task.dimensions) if len(questions) > 1 else states
        ids = [question.trial_id for _, question in questions]
        try:
            answer = task.model.predict(asked, explore, ids if explore else None)
        except CrkrError:
            for request, _ in questions:
                try:
                    self._answer_alone(request, task)
                except BaseException as error:
                    request.fail_unexpectedly(error)
            return
        rows = packed_rows(answer, ids, (time.perf_counter_ns() - started) // 1000)
        for (request, question), row in zip(questions, rows, strict=True):
            request.reply_packed(row)
            if explore and question.worker:
                self._workers.asked(task.name, question.worker, (question.trial_id,))

    def _answer_alone(self, request: Request, task: ServedTask) -> None:
        """Answer a request of any form, checked in full."""
        batch = _Batch.begin(request, task)
        while not batch.step():
            pass
        self._reply(request, batch.question, batch.result(), batch.ids, batch.compute_us)

    def _reply(
        self, request: Request, question: PredictRequest, answer: Prediction, ids: Sequence[bytes], compute_us: int
    ) -> None:
        request.reply_packed(pack({**answer.to_wire(), "compute_us": compute_us}))
        if question.explore and question.worker is not None:
            self._workers.asked(request.task, question.worker, ids)


@final
class _Batch:
    """A question about many states, answered a few at a time by the model of its beginning.

    Slices are short because solving with the factor blocks other Python threads.
    """

    __slots__ = ("_done", "_model", "_novel", "_parts", "_states", "_step", "compute_us", "ids", "question")

    def __init__(self, question: PredictRequest, task: ServedTask) -> None:
        self.question, self._model = question, task.model
        self.ids = [one.bytes for one in question.trial_ids] or random_ids(question.count)
        self.compute_us = self._done = 0
        self._states = np.atleast_2d(question.states)
        cost = _Cost.of(task, self._model)
        self._step = max(cost.least, int((_AT_ONCE_US - cost.once_us) / cost.state_us))
        self._parts: list[Prediction] = []
        self._novel: NovelState | None = None  # the most novel refused state so far

    @classmethod
    def begin(cls, request: Request, task: ServedTask) -> Self:
        """Read a request; raises `Invalid`, also for one whose answer would not fit into a message."""
        question = PredictRequest.from_wire(request.message(), task.dimensions)
        _refuse_long_answer(task, question.count)
        return cls(question, task)

    @property
    def share_left(self) -> float:
        """Remaining share, from 1 to 0."""
        return 1.0 - self._done / len(self._states)

    def step(self) -> bool:
        """Work for about a millisecond; True when done."""
        started = time.perf_counter_ns()
        if not self._model.explorer.prepare(self._step):
            return False
        first, self._done = self._done, min(self._done + self._step, len(self._states))
        one = self.question.states.ndim == 1
        states = self.question.states if one else self._states[first : self._done]
        try:
            self._parts.append(self._model.predict(states, self.question.explore, self.ids[first : self._done]))
        except NovelState as error:
            self._note_novel(error, first)
        self.compute_us += (time.perf_counter_ns() - started) // 1000
        return self._done == len(self._states)

    def result(self) -> Prediction:
        """The answer, once done; raises `NovelState` with the most novel of all states."""
        if self._novel is not None:
            raise self._novel
        return self._parts[0] if len(self._parts) == 1 else Prediction.joined(self._parts)

    def _note_novel(self, error: NovelState, first: int) -> None:
        if self._novel is None or error.details["novelty"] > self._novel.details["novelty"]:
            index = error.details["index"]
            message = error.message.replace(f"state {index} ", f"state {index + first} ", 1)
            self._novel = NovelState(message, details={**error.details, "index": index + first})


class _Cost(NamedTuple):
    """Estimated time of predictions by a model, without the fixed cost of a question.

    Attributes:
        once_us: For any number of states [us].
        state_us: For each state [us].
        least: Fewest states to answer at a time.
    """

    once_us: float
    state_us: float
    least: int

    @classmethod
    def of(cls, task: ServedTask, model: Model) -> _Cost:
        square, searched = model.active**2, model.explorer.searched
        guided = _GUIDED_US + _TRIAL_US * searched + _local_fit_us(task.created, searched) if searched else 0.0
        state_us = _STATE_US + _SQUARE_US * square + guided
        filling = not (model.active or searched) or model.tried < task.created.start.count
        once_us = _PASS_US * square + (_FILL_US * len(task.created.goal) ** 2 if filling else 0.0)
        return cls(once_us, state_us, max(1, min(_LEAST, int(_LONG_US / state_us))))

    def us(self, count: int) -> float:
        """Time for `count` states [us]."""
        return self.once_us + count * self.state_us


def _local_fit_us(spec: TaskSpec, searched: int) -> float:
    """Estimated time of the fits to a state's nearest trials, and of the candidates [us]."""
    groups, own = len({entry.group for entry in spec.outcome}), spec.exploration
    near, more = min(own.neighbours, MOST_NEIGHBOURS, searched), max(0, own.candidates - _USUAL_CANDIDATES)
    return groups * (_GROUP_US + _FIT_US * near**3 + _CANDIDATE_US * near * more)


def _refuse_long_answer(task: ServedTask, count: int) -> None:
    """Raise `Invalid` if the predictions of `count` states do not fit into a message."""
    spec = task.created
    most = most_states_answered(len(spec.goal), len(spec.outcome) if spec.exploration.type == "outcome" else 0)
    if count > most:
        raise Invalid(
            f"the answer for {count} states at once would be too large a message; ask task {task.name!r} about at "
            f"most {most} at a time",
            details={"field": "states", "most": most},
        )


def _states(message: Mapping[str, Any]) -> int:
    """Number of states that a request seems to have, before the full check."""
    states = message.get("states")
    if type(states) is dict:
        shape = states.get("shape")
        return max(1, shape[0]) if type(shape) is list and len(shape) == 2 and type(shape[0]) is int else 1
    return len(states) if type(states) is list and states and type(states[0]) is list else 1


def _question(message: Mapping[str, Any], dimensions: int) -> Question | None:
    """A request about one state that can be answered together with others; None if it needs the full check."""
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
