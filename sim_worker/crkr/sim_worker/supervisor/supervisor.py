"""The supervisor of one `crkr workers`: hands out trials and evaluations, and survives lost workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, final

from crkr.client import Task
from crkr.client.cli.stop_request import StopRequest
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluation.epoch_schedule import EpochAssignments, JudgeRole
from crkr.sim_worker.supervisor.plan import RunPlan, RunReport
from crkr.sim_worker.supervisor.processes import WorkerProcess, WorkerProcesses
from crkr.sim_worker.supervisor.quota import Quota
from crkr.sim_worker.supervisor.stall import StallWatch
from crkr.sim_worker.worker.process import ProcessSettings, run_worker

__all__ = ["Supervisor", "training_trials"]

TICKETS_AHEAD: Final = 2  # so that a worker never waits for its supervisor
POLL_S: Final = 0.2
SHARED_POLL_S: Final = 0.05  # if others train towards the same total and it is near, or this supervisor judges
LONGEST_POLL_S: Final = 2.0
_LOOKS: Final = 10  # looks while the rest shrinks to a third
STATUS_TIMEOUT_S: Final = 1.0


def training_trials(status: Mapping[str, Any]) -> int:
    """Training trials of a task: kinds trial and failed."""
    samples = status["samples"]
    return int(samples.get("trial", 0)) + int(samples.get("failed", 0))


@final
class Supervisor:
    """Runs worker processes until the task has its total.

    Args:
        plan: What to do.
        task: The task, with its demonstrations.
        settings: Settings of each process; each gets its own identity.
        seeds: Seed of each worker.
        trained: Training trials stored at the start.
        judge: The role of the judge; None where this supervisor judges nothing.
        say: Prints a line for people.
        show: Shows the training trials stored and a remark, often.
    """

    def __init__(
        self,
        plan: RunPlan,
        task: Task,
        settings: ProcessSettings,
        seeds: Sequence[int],
        trained: int,
        judge: JudgeRole | None,
        say: Callable[[str], None],
        show: Callable[[int, str], None],
    ) -> None:
        self._plan = plan
        self._task = task
        self._settings = settings
        self._seeds = seeds
        self._judge = judge
        self._epochs = EpochAssignments()
        self._say = say
        self._show = show
        self._report = RunReport(task.name, plan.workers)
        self._quota = Quota(plan.total, trained)
        self._complete = plan.total is not None and trained >= plan.total
        self._workers: list[WorkerProcess] = []
        self._away: set[WorkerProcess] = set()
        # Two calls of a trial may take their whole deadline before the worker reports that the server is away.
        self._stalls: StallWatch[WorkerProcess] = StallWatch(plan.stall_s + 2 * plan.timeout_s)
        self._next_poll = 0.0
        self._rate = 0.0  # training trials stored a second, of all supervisors
        self._looked = (time.monotonic(), trained)
        self._started = time.monotonic()

    def run(self) -> RunReport:
        """Trains until the total is reached and judged, a signal comes, or the last worker is lost."""
        self._started = time.monotonic()
        self._assign_epochs()
        with StopRequest() as stop, WorkerProcesses() as processes:
            if not self._finished:
                self._start_workers(processes)
                self._assign_epochs()
            while not (stop or self._report.problem or self._finished):
                self._hand_out()
                for worker, event in processes.events(min(self._poll_s, POLL_S)):
                    self._handle(worker, event)
                    self._assign_epochs()
                self._poll()
                self._assign_epochs()
                self._kill_stalled()
                self._show(self._quota.trained, self._remark())
            self._report.stopped_by = stop.signal
            for worker, event in processes.stop():
                self._count(worker, event)
        return self._finished_report()

    @property
    def _finished(self) -> bool:
        return self._complete and not self._epochs.unfinished

    def _start_workers(self, processes: WorkerProcesses) -> None:
        identity = self._settings.identity
        for index, seed in enumerate(self._seeds):
            own = replace(self._settings, identity=replace(identity, worker=f"{identity.worker}-{index}", seed=seed))
            self._workers.append(processes.start(f"worker {index}", run_worker, own))

    def _assign_epochs(self) -> None:
        """Gives epochs that have ended to workers, where this supervisor is the judge."""
        if self._judge is not None:
            self._judge.update(self._quota.trained)
            self._epochs.assign(self._judge.clock, self._quota.trained, self._workers)

    @property
    def _others_begin(self) -> bool:
        """Whether another supervisor, the judge, has yet to ask the first epoch's model: then it trains first."""
        return self._judge is not None and self._judge.clock is None and self._quota.trained == 0

    def _hand_out(self) -> None:
        """Keeps each worker supplied with tickets."""
        if self._complete or self._epochs.holds_up_training or self._others_begin:
            return
        for worker in self._workers:
            granted = self._quota.grant(max(0, TICKETS_AHEAD - worker.tickets))
            worker.tickets += granted
            for _ in range(granted):
                worker.send("go")

    @property
    def _at_the_end(self) -> bool:
        """Whether few tickets are left: then the server is asked for others' trials before each."""
        left = self._quota.left
        return left is not None and left <= 2 * TICKETS_AHEAD * len(self._workers)

    @property
    def _poll_s(self) -> float:
        """Seconds between looks: a tenth of the remaining time, so that a hundred supervisors ask little."""
        judges = self._judge is not None and self._judge.clock is not None
        if self._at_the_end or (judges and self._quota.shared):
            return SHARED_POLL_S
        left = self._quota.left
        if judges or left is None or not self._rate or not self._quota.shared:
            return POLL_S if judges or left is not None else LONGEST_POLL_S / 2
        return min(max(left / self._rate / _LOOKS, SHARED_POLL_S), LONGEST_POLL_S)

    def _poll(self) -> None:
        """Asks the server for the trials of other supervisors, and whether the total is reached."""
        if self._complete or (time.monotonic() < self._next_poll and not self._at_the_end):
            return
        self._next_poll = time.monotonic() + self._poll_s
        under_way = sum(worker.tickets for worker in self._workers)
        try:
            stored = training_trials(self._task.status(brief=True, timeout_s=STATUS_TIMEOUT_S))
        except CrkrError:
            return  # the workers, which are more patient, report that the server is away
        now, (before, seen) = time.monotonic(), self._looked
        if now - before >= POLL_S:
            self._rate, self._looked = max(0, stored - seen) / (now - before), (now, stored)
        self._quota.observe(stored)
        if self._quota.left == 0 and not under_way:
            self._quota.settle(stored)
            self._complete = self._quota.left == 0

    def _handle(self, worker: WorkerProcess, event: dict[str, Any] | None) -> None:
        if event is None:
            self._lose(worker)
            return
        self._stalls.heard(worker)
        self._count(worker, event)
        match event:
            case {"event": "failed", "reason": reason}:
                worker.reason = reason
            case {"event": "away", "reason": reason}:
                if not self._away:
                    self._say(f"warning: {reason}; trying again for {self._plan.patience_s:g} s")
                self._away.add(worker)
            case {"event": "back"}:
                self._away.discard(worker)
                if not self._away:
                    self._say("the server answers again")

    def _count(self, worker: WorkerProcess, event: dict[str, Any]) -> None:
        """Counts what was stored."""
        self._epochs.handle(event)
        match event:
            case {"event": "done", "success": success}:
                worker.tickets -= 1
                self._quota.done()
                self._report.trials += 1
                self._report.successes += bool(success)

    def _kill_stalled(self) -> None:
        busy = [worker for worker in self._workers if worker.tickets or self._epochs.is_busy(worker)]
        hanging = self._stalls.look(
            [worker for worker in busy if worker.silent_s is None], self._away, self._plan.patience_s
        )
        for worker, silent_s in hanging.items():
            worker.kill(silent_s)

    def _lose(self, worker: WorkerProcess) -> None:
        self._away.discard(worker)
        self._workers.remove(worker)
        self._epochs.release(worker)
        self._report.workers_lost += 1
        left = f"{len(self._workers)} of {self._plan.workers} go on" if self._workers else "none is left"
        self._say(f"warning: {worker.name} (process {worker.process.pid}) {worker.ending()}; {left}")
        if not self._workers:
            self._report.problem = "all workers are lost" + (
                f"; the last one said: {worker.reason}" if worker.reason else ""
            )

    def _remark(self) -> str:
        done, seconds = self._report.trials, time.monotonic() - self._started
        parts = [f"{done / max(1e-3, seconds):.0f}/s"] if done else []
        if self._away:
            parts.append("waiting for the server")
        if self._complete:
            parts.append(f"{self._epochs.unfinished} evaluations to be finished")
        if self._epochs.rates:
            last = max(self._epochs.rates)
            marks = ", ".join(f"{name} {rate:.0%}" for name, rate in self._epochs.rates[last].items())
            parts.append(f"after epoch {last}: {marks}")
        return ", ".join(parts)

    def _finished_report(self) -> RunReport:
        self._report.seconds = time.monotonic() - self._started
        self._report.trained = self._quota.trained
        self._report.epochs = self._epochs.rates
        return self._report
