"""Answers `predict` from the model at hand: what waits together is answered together, and nothing waits to fill up."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from typing import Any, Final, final

import numpy as np

from crkr.protocol import CrkrError, Invalid, PredictRequest, pack
from crkr.server.prediction_wire import packed_rows, state_bytes
from crkr.server.request import Request
from crkr.server.tasks import ServedTask, Tasks
from crkr.server.workers import Workers

__all__ = ["Predictor"]

_Question = tuple[Request, dict[str, Any], bytes]  # request, its message, the bytes of its one state


_VERSION: Final = 6  # byte of a UUID
_VARIANT: Final = 8
_LONGEST: Final = 128  # name of a worker


@final
class Predictor:
    """The work of the predict lanes; any thread may call it."""

    def __init__(self, tasks: Tasks, workers: Workers) -> None:
        self._tasks, self._workers = tasks, workers

    def answer(self, requests: list[Request]) -> None:
        """Answers every one of them, with a prediction or an error."""
        together: defaultdict[tuple[str, bool], list[_Question]] = defaultdict(list)
        for request in requests:
            try:
                task = self._tasks.get(request.task)
                message = request.message()
                state = state_bytes(message, task.dimensions)
                explore = message.get("explore", False)
                worker = message.get("worker") or ""
                if state is None or type(explore) is not bool or type(worker) is not str or len(worker) > _LONGEST:
                    self._answer_alone(request, task, message)
                else:
                    together[request.task, explore].append((request, message, state))
            except Exception as error:  # this one's fault alone; it is answered and the others go on
                request.fail_unexpectedly(error)
        for (name, explore), questions in together.items():
            self._answer_together(self._tasks.get(name), explore, questions)

    def _answer_together(self, task: ServedTask, explore: bool, questions: list[_Question]) -> None:
        """One call of the model for all; where one of them is refused, each is asked alone."""
        started = time.perf_counter_ns()
        states = np.frombuffer(b"".join(state for _, _, state in questions), "<f8")
        try:
            ids = [_trial_id(message) for _, message, _ in questions]
            asked = states.reshape(len(questions), task.dimensions) if len(questions) > 1 else states
            answer = task.model.predict(asked, explore, ids if explore else None)
        except CrkrError:
            for request, message, _ in questions:
                try:
                    self._answer_alone(request, task, message)
                except Exception as error:
                    request.fail_unexpectedly(error)
            return
        rows = packed_rows(answer, ids, (time.perf_counter_ns() - started) // 1000)
        for (request, message, _), identity, row in zip(questions, ids, rows, strict=True):
            request.reply_packed(row)
            if explore and (worker := message.get("worker")):
                self._workers.asked(task.name, worker, (identity,))

    def _answer_alone(self, request: Request, task: ServedTask, message: dict[str, Any]) -> None:
        """Any form of request, checked in full."""
        question = PredictRequest.from_wire(message, task.dimensions)
        started = time.perf_counter_ns()
        ids = [one.bytes for one in question.trial_ids] or [_new_id() for _ in range(question.count)]
        answer = task.model.predict(question.states, question.explore, ids)
        reply = answer.to_wire()
        reply["compute_us"] = (time.perf_counter_ns() - started) // 1000
        request.reply_packed(pack(reply))
        if question.explore and question.worker is not None:
            self._workers.asked(task.name, question.worker, ids)


def _new_id() -> bytes:
    """A random UUID (version 4) as bytes."""
    identity = bytearray(os.urandom(16))
    identity[_VERSION] = identity[_VERSION] & 0x0F | 0x40
    identity[_VARIANT] = identity[_VARIANT] & 0x3F | 0x80
    return bytes(identity)


def _trial_id(message: dict[str, Any]) -> bytes:
    """The client's id as it is, or a new one; the model checks them."""
    given = message.get("trial_ids")
    if given is None:
        return _new_id()
    if type(given) is list and len(given) == 1 and type(given[0]) is bytes and len(given[0]) == 16:
        return bytes(given[0])
    raise Invalid("trial_ids must be one id of 16 bytes for one state")
