"""The training loop: draw a situation, ask for a goal, execute it, report the trial, publish it."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import partial
from typing import Final, final
from uuid import UUID

import numpy as np

from crkr.client import Task
from crkr.protocol import Array, Conflict, Internal, Prediction, Receipt, Trial, pack, training_id
from crkr.protocol.info import MAX_INFO_BYTES
from crkr.sim_worker.randomness import training_rng, unpredictable_seed
from crkr.sim_worker.skill import Skill, TrialResult
from crkr.sim_worker.worker.supervisor_link import SupervisorLink
from crkr.sim_worker.worker.telemetry import Telemetry, Timing

__all__ = ["Identity", "TrialLoop", "tried"]

logger = logging.getLogger(__name__)

_MOST_REFUSED: Final = 10  # refused goals in a row after which the worker ends


@final
@dataclass(frozen=True, slots=True)
class Identity:
    """Names and seeds of a worker.

    Attributes:
        worker: Name in the log and on displays.
        seed: Of the situations it draws.
        first_seq: Log position when it started; its trials' ids derive from it and the seed.
    """

    worker: str
    seed: int
    first_seq: int


def tried(task: Task, answer: Prediction, result: TrialResult, worker: str) -> Trial:
    """The training trial of a result; a goal that was not executed gives kind "failed"."""
    expected = answer.expectation()
    if len(pack(result.info)) > MAX_INFO_BYTES // 2:  # the skill's own comes first
        expected = {}
    return Trial.create(
        task.spec,
        id=answer.trial_id,
        state=answer.state,
        goal=answer.goal,
        cost=result.cost,
        success=result.success and result.executed,
        kind="trial" if result.executed else "failed",
        outcome=result.outcome,
        worker=worker,
        model_version=answer.model_version,
        info={**expected, **result.info},
        learn=result.learn if result.executed else None,
    )


@final
class TrialLoop:
    """Runs training trials one after the other.

    Args:
        task: What is learned.
        skill: Executes the goals.
        identity: Names and seeds.
        link: To the supervisor.
        telemetry: Publishes trials for displays.
        wait: Reports return when the model includes the trial; one worker then repeats a run of its seed.
    """

    def __init__(
        self,
        task: Task,
        skill: Skill,
        identity: Identity,
        link: SupervisorLink,
        telemetry: Telemetry,
        *,
        wait: bool = False,
    ) -> None:
        self._task = task
        self._skill = skill
        self._identity = identity
        self._link = link
        self._wait = wait
        self._telemetry = telemetry
        self._seed = identity.seed
        self._rng = training_rng(identity.seed, identity.first_seq)
        self._count = 0

    def run_one(self) -> Trial:
        """Tries one goal in a new situation; returns when the trial is stored.

        Raises:
            CrkrError: The server refuses, is away for longer than the patience, or proposes only goals that are out of
                bounds or not finite. Such a goal is not executed, and only telemetry shows it.
            Stopped: The supervisor wants this process to end.
        """
        while True:
            try:
                trial = self._run_one()
            except Conflict:
                trial = None
            if trial is not None:
                return trial
            # Another supervisor was started with the same seed at the same log position.
            self._seed = unpredictable_seed()
            self._rng = training_rng(self._seed, self._identity.first_seq)
            logger.warning("another worker uses this seed; %s draws a new one", self._identity.worker)

    def _run_one(self) -> Trial | None:
        """One trial; None where another worker has stored the same one."""
        answer, started = self._ask()
        predicted = time.monotonic()
        result = self._skill.execute(answer.goal)
        executed = time.monotonic()
        trial = tried(self._task, answer, result, self._identity.worker)
        receipt = self._link.retry_while_away(lambda: self._task.report_trials([trial], wait=self._wait))
        if not (receipt.accepted or self._is_mine(trial, receipt)):
            return None
        timing = _timing(started, predicted, executed, time.monotonic())
        self._show(trial, receipt, answer, result, timing)
        return trial

    def _ask(self) -> tuple[Prediction, float]:
        """The answer for the next situation with a valid goal, and the time of the question."""
        low, high = self._task.spec.bounds
        for _ in range(_MOST_REFUSED):
            self._count += 1
            trial_id = training_id(self._task.name, self._seed, self._identity.first_seq, self._count)
            state = self._skill.reset(self._rng)
            started = time.monotonic()
            answer = self._link.retry_while_away(partial(self._predict, state, trial_id))
            if np.all((answer.goal >= low) & (answer.goal <= high)):  # NaN is neither
                return answer, started
            self._telemetry.refused(answer, self._identity.worker)
            logger.warning("refused goal %s: it is out of bounds or not finite", answer.goal.tolist())
        raise Internal(
            f"{_MOST_REFUSED} goals in a row are out of the bounds of task {self._task.name!r} or not finite; "
            "look at the server's version and at the task's specification"
        )

    def _predict(self, state: Array, trial_id: UUID) -> Prediction:
        try:
            return self._task.predict(state, explore=True, trial_ids=[trial_id], worker=self._identity.worker)
        except Internal as error:
            refused = error.details.get("prediction")
            if isinstance(refused, Prediction):  # the proposal that the client refused
                return refused
            raise

    def _is_mine(self, trial: Trial, receipt: Receipt) -> bool:
        """Whether a duplicate is this worker's own, stored by an attempt whose answer was lost."""
        before = receipt.seqs[0] - 1
        page, _ = self._link.retry_while_away(lambda: self._task.samples(before, 1))
        return any(stored.trial.id == trial.id and stored.trial.worker == trial.worker for stored in page)

    def _show(self, trial: Trial, receipt: Receipt, answer: Prediction, result: TrialResult, timing: Timing) -> None:
        self._telemetry.publish(
            trial,
            receipt.seqs[0],
            trace=result.trace,
            sigma=answer.sigma,
            novelty=float(answer.novelty),
            timing=timing,
        )


def _timing(started: float, predicted: float, executed: float, reported: float) -> Timing:
    return Timing(1e3 * (predicted - started), 1e3 * (executed - predicted), 1e3 * (reported - executed))
