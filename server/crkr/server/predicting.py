"""Answers `predict` from the model at hand: what waits together is answered together, and nothing waits to fill up."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import final
from uuid import UUID, uuid4

import numpy as np

from crkr.learner import Model
from crkr.protocol import Array, CrkrError, Prediction, PredictRequest, pack
from crkr.server.request import Request
from crkr.server.tasks import ServedTask, Tasks
from crkr.server.workers import Workers

__all__ = ["Predictor"]


@final
class Predictor:
    """The work of the predict lanes; any thread may call it."""

    def __init__(self, tasks: Tasks, workers: Workers) -> None:
        self._tasks, self._workers = tasks, workers

    def answer(self, requests: list[Request]) -> None:
        """Answers every one of them, with a prediction or an error."""
        groups: defaultdict[tuple[str, bool], list[_Question]] = defaultdict(list)
        for request in requests:
            try:
                question = _Question(request, self._tasks.get(request.task))
            except Exception as error:  # this one's fault alone; it is answered and the others go on
                request.fail_unexpectedly(error)
            else:
                groups[request.task, question.asked.explore].append(question)
        for questions in groups.values():
            self._answer_group(questions)

    def _answer_group(self, questions: list[_Question]) -> None:
        model = questions[0].task.model
        if len(questions) > 1 and self._answer_together(questions, model):
            return
        for question in questions:
            started = time.perf_counter_ns()
            try:
                answer = model.predict(question.asked.states, question.asked.explore, question.ids)
            except Exception as error:
                question.request.fail_unexpectedly(error)
            else:
                self._reply(question, answer, started)

    def _answer_together(self, questions: list[_Question], model: Model) -> bool:
        """One call for all; False where one of them is refused, so that each must be asked alone."""
        started = time.perf_counter_ns()
        rows = [np.atleast_2d(question.asked.states) for question in questions]
        ids = [identity for question in questions for identity in question.ids]
        try:
            answer = model.predict(np.concatenate(rows), questions[0].asked.explore, ids)
        except CrkrError:
            return False
        first = 0
        for question, own in zip(questions, rows, strict=True):
            at = first if question.asked.states.ndim == 1 else slice(first, first + len(own))
            first += len(own)
            self._reply(question, _part(answer, question, at), started)
        return True

    def _reply(self, question: _Question, answer: Prediction, started_ns: int) -> None:
        message = answer.to_wire()
        message["compute_us"] = (time.perf_counter_ns() - started_ns) // 1000
        question.request.reply_packed(pack(message))
        if question.asked.explore and question.asked.worker is not None:
            self._workers.asked(question.task.name, question.asked.worker, question.ids)


@final
class _Question:
    """A decoded request; ids are made here where the client made none."""

    __slots__ = ("asked", "ids", "request", "task")

    def __init__(self, request: Request, task: ServedTask) -> None:
        self.request, self.task = request, task
        self.asked = PredictRequest.from_wire(request.message(), len(task.created.state))
        self.ids: list[UUID] = list(self.asked.trial_ids) or [uuid4() for _ in range(self.asked.count)]


def _part(whole: Prediction, question: _Question, at: int | slice) -> Prediction:
    """One question's share of a common answer."""

    def own(array: Array | None) -> Array | None:
        return None if array is None else np.asarray(array[at])

    return Prediction(
        states=question.asked.states,
        goals=np.asarray(whole.goals[at]),
        means=np.asarray(whole.means[at]),
        sigmas=np.asarray(whole.sigmas[at]),
        novelty=np.asarray(whole.novelty[at]),
        trial_ids=question.ids,
        model_version=whole.model_version,
        active=whole.active,
        policy=whole.policy,
        predicted_outcome=own(whole.predicted_outcome),
        predicted_outcome_sd=own(whole.predicted_outcome_sd),
    )
