"""Runs workers side by side: hands out trials and evaluations, and goes on when one of them is lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, final

from crkr.client import Task
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluation.judge import JudgeSeat
from crkr.sim_worker.evaluation.schedule import EvaluationDesk
from crkr.sim_worker.supervisor.launch_plan import LaunchPlan, LaunchReport
from crkr.sim_worker.supervisor.processes import Fleet, Member
from crkr.sim_worker.supervisor.quota import Quota
from crkr.sim_worker.supervisor.stall import StallWatch
from crkr.sim_worker.supervisor.stop_request import StopRequest
from crkr.sim_worker.worker.process import ProcessSettings, run_worker

__all__ = ["Launcher", "training_trials"]

TICKETS_AHEAD: Final = 2  # so that a worker never waits for its launcher
POLL_S: Final = 0.2
SHARED_POLL_S: Final = 0.05  # where others train towards the same total
STATUS_TIMEOUT_S: Final = 1.0


def training_trials(status: Mapping[str, Any]) -> int:
    """Training trials of a task: kinds trial and failed."""
    samples = status["samples"]
    return int(samples.get("trial", 0)) + int(samples.get("failed", 0))


@final
class Launcher:
    """Supervises the processes of one `crkr workers`.

    Args:
        plan: What to do.
        task: The task, with its demonstrations.
        settings: What each process needs; the identity is made each one's own.
        seeds: Seed of each worker.
        trained: Training trials stored at the start.
        seat: This launcher's part in judging; None where it has none.
        say: Prints a line for people.
        show: Shows the training trials stored and a remark, often.
    """

    def __init__(
        self,
        plan: LaunchPlan,
        task: Task,
        settings: ProcessSettings,
        seeds: Sequence[int],
        trained: int,
        seat: JudgeSeat | None,
        say: Callable[[str], None],
        show: Callable[[int, str], None],
    ) -> None:
        self._plan = plan
        self._task = task
        self._settings = settings
        self._seeds = seeds
        self._seat = seat
        self._desk = EvaluationDesk()
        self._say = say
        self._show = show
        self._report = LaunchReport(task.name, plan.workers)
        self._quota = Quota(plan.total, trained)
        self._complete = plan.total is not None and trained >= plan.total
        self._workers: list[Member] = []
        self._away: set[Member] = set()
        # A call may take its time twice in a trial before the worker says that the server is away.
        self._stalls: StallWatch[Member] = StallWatch(plan.stall_s + 2 * plan.timeout_s)
        self._next_poll = 0.0
        self._started = time.monotonic()

    def run(self) -> LaunchReport:
        """Trains until the total is reached and judged, a signal comes, or the last worker is lost."""
        self._started = time.monotonic()
        self._look()
        with StopRequest() as stop, Fleet() as fleet:
            if not self._finished:
                self._start_workers(fleet)
                self._look()
            while not (stop or self._report.problem or self._finished):
                self._hand_out()
                for member, event in fleet.events(self._poll_s):
                    self._handle(member, event)
                    self._look()
                self._poll()
                self._look()
                self._give_up_who_hangs()
                self._show(self._quota.trained, self._remark())
            self._report.stopped_by = stop.signal
            for member, event in fleet.stop():
                self._count(member, event)
        return self._finished_report()

    @property
    def _finished(self) -> bool:
        return self._complete and not self._desk.unfinished

    def _start_workers(self, fleet: Fleet) -> None:
        identity = self._settings.identity
        for index, seed in enumerate(self._seeds):
            own = replace(self._settings, identity=replace(identity, worker=f"{identity.worker}-{index}", seed=seed))
            self._workers.append(fleet.start(f"worker {index}", run_worker, own))

    def _look(self) -> None:
        """Has epochs judged that have ended, where that is this launcher's part."""
        if self._seat is not None:
            self._seat.look(self._quota.trained)
            self._desk.look(self._seat.clock, self._quota.trained, self._workers)

    @property
    def _others_begin(self) -> bool:
        """Whether the launcher that has epochs judged has yet to ask the first epoch's model: then it trains first."""
        return self._seat is not None and self._seat.clock is None and self._quota.trained == 0

    def _hand_out(self) -> None:
        """Keeps each worker in tickets."""
        if self._complete or self._desk.holds_up_training or self._others_begin:
            return
        for worker in self._workers:
            granted = self._quota.grant(max(0, TICKETS_AHEAD - worker.tickets))
            worker.tickets += granted
            for _ in range(granted):
                worker.order("go")

    @property
    def _at_the_end(self) -> bool:
        """Whether the last tickets are about to be granted: then others' trials are looked for before each."""
        left = self._quota.left
        return left is not None and left <= 2 * TICKETS_AHEAD * len(self._workers)

    @property
    def _poll_s(self) -> float:
        return SHARED_POLL_S if self._quota.shared or self._at_the_end else POLL_S

    def _poll(self) -> None:
        """Learns from the server what other launchers did, and whether the total is reached."""
        if self._complete or (time.monotonic() < self._next_poll and not self._at_the_end):
            return
        self._next_poll = time.monotonic() + self._poll_s
        under_way = sum(worker.tickets for worker in self._workers)
        try:
            stored = training_trials(self._task.status(timeout_s=STATUS_TIMEOUT_S))
        except CrkrError:
            return  # the workers, who are more patient, tell when the server is away
        self._quota.observe(stored)
        if self._quota.left == 0 and not under_way:
            self._quota.settle(stored)
            self._complete = self._quota.left == 0

    def _handle(self, member: Member, event: dict[str, Any] | None) -> None:
        if event is None:
            self._lose(member)
            return
        self._stalls.heard(member)
        self._count(member, event)
        match event:
            case {"event": "failed", "reason": reason}:
                member.reason = reason
            case {"event": "away", "reason": reason}:
                if not self._away:
                    self._say(f"warning: {reason}; trying again for {self._plan.patience_s:g} s")
                self._away.add(member)
            case {"event": "back"}:
                self._away.discard(member)
                if not self._away:
                    self._say("the server answers again")

    def _count(self, member: Member, event: dict[str, Any]) -> None:
        """Takes what was stored into the account."""
        self._desk.handle(event)
        match event:
            case {"event": "done", "success": success}:
                member.tickets -= 1
                self._quota.done()
                self._report.trials += 1
                self._report.successes += bool(success)

    def _give_up_who_hangs(self) -> None:
        busy = [worker for worker in self._workers if worker.tickets or self._desk.owed_by(worker)]
        hanging = self._stalls.look(
            [worker for worker in busy if worker.silent_s is None], self._away, self._plan.patience_s
        )
        for worker, silent_s in hanging.items():
            worker.give_up(silent_s)

    def _lose(self, worker: Member) -> None:
        self._away.discard(worker)
        self._workers.remove(worker)
        self._desk.lose(worker)
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
            parts.append(f"{self._desk.unfinished} evaluations to be finished")
        if self._desk.rates:
            last = max(self._desk.rates)
            marks = ", ".join(f"{name} {rate:.0%}" for name, rate in self._desk.rates[last].items())
            parts.append(f"after epoch {last}: {marks}")
        return ", ".join(parts)

    def _finished_report(self) -> LaunchReport:
        self._report.seconds = time.monotonic() - self._started
        self._report.trained = self._quota.trained
        self._report.epochs = self._desk.rates
        return self._report
