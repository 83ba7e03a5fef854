"""The log and the workers' publications, joined and passed to a display.

The log is the truth about trials: a view gets each trial once and in order, earlier ones too, whatever publications are
lost and however often the server restarts. Publications add poses, widths and durations, which are not in the log. A
picture waits until its trial is read from the log, usually half a second.
"""

from __future__ import annotations

import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, final

from crkr.client import Subscription
from crkr.dashboard.poller import Update
from crkr.dashboard.progress import EpochResult, Progress, Row
from crkr.dashboard.telemetry import Telemetry
from crkr.protocol import CrkrError, StoredTrial, Unavailable

__all__ = ["NOT_STORED", "Feed", "View"]

_logger = logging.getLogger(__name__)
MAX_WAITING: Final = 512
MAX_REMEMBERED: Final = 4096
NOT_STORED: Final = "Replayed from the log, which has no poses, paths, widths or durations: workers only publish them."


class View(Protocol):
    """A display. It is called from one thread and must not wait."""

    def task(self, description: str) -> None:
        """The task's description, "" without one; called first."""

    def trials(self, rows: Sequence[Row], progress: Progress) -> None:
        """New trials of the log, in order."""

    def picture(self, row: Row, telemetry: Telemetry) -> None:
        """A worker's publication about one of these trials."""

    def epoch(self, result: EpochResult, progress: Progress) -> None:
        """An evaluation is complete."""

    def status(self, status: Mapping[str, Any], progress: Progress, now: float) -> None:
        """The server's answer to `status`; `now` is monotonic [s]."""

    def say(self, message: str, *, warning: bool = False) -> None:
        """One line for the user."""

    def tick(self, now: float, progress: Progress) -> None:
        """Time passed; `now` is monotonic [s]."""


@final
@dataclass(slots=True)
class _LoggedTrial:
    """A trial of the log: its row, its worker, and whether a picture of it was shown."""

    row: Row
    worker: str | None
    pictured: bool = False


@final
class Feed:
    """Updates and publications, as calls of a view.

    Attributes:
        progress: The run so far.
        skipped: Publications and answers that could not be read or shown.
        refused: Goals that workers refused.
        dropped: Pictures that waited too long for their trial, or were not its first.
    """

    def __init__(self, view: View, progress: Progress | None = None) -> None:
        self.progress = progress or Progress()
        self.skipped = 0
        self.refused = 0
        self.dropped = 0
        self._view = view
        self._logged: OrderedDict[int, _LoggedTrial] = OrderedDict()
        self._waiting: OrderedDict[tuple[int, str], Telemetry] = OrderedDict()  # by log position and worker
        self._lost = False
        self._ahead = False
        self._caught_up = False

    def publication(self, topic: str, message: Mapping[str, Any]) -> None:
        """Add a publication; one that cannot be read is counted and skipped."""
        if topic not in ("trial", "evaluation"):
            return
        if message.get("kind") == "failed" and "seq" not in message:
            self._attempt(lambda: self._note_refusal(message))
            return
        self._attempt(lambda: self._wait(Telemetry.from_wire(message)))

    def _wait(self, telemetry: Telemetry) -> None:
        key = telemetry.seq, telemetry.worker
        if key in self._waiting:
            self.dropped += 1
            return
        self._waiting[key] = telemetry
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popitem(last=False)
            self.dropped += 1

    def take(self, subscription: Subscription, patience_s: float) -> bool:
        """Add the next publication within `patience_s` [s]; False without one."""
        received: list[tuple[str, dict[str, Any]] | None] = []
        self._attempt(lambda: received.append(subscription.receive(patience_s)))
        for each in received:
            if each is None:
                return False
            self.publication(*each)
        return True

    def _attempt(self, action: Callable[[], object]) -> None:
        """Handle a message of another program; an error is counted and shown, and the display continues."""
        try:
            action()
        except (KeyboardInterrupt, SystemExit, GeneratorExit):
            raise
        except BaseException as error:  # nesting too deep, numbers too large, a binding's panic
            self.skipped += 1
            # The first few say what is wrong; a flood of them must not fill the log.
            if self.skipped <= 3 or self.skipped % 1000 == 0:
                reason = error.message if isinstance(error, CrkrError) else f"{type(error).__name__}: {error!s:.200}"
                self._view.say(f"skipped {self.skipped} unreadable publications: {reason}", warning=True)

    def _note_refusal(self, message: Mapping[str, Any]) -> None:
        """Count a goal that a worker refused; the log has no trial of it."""
        self.refused += 1
        if self.refused <= 3 or self.refused % 1000 == 0:
            worker = str(message.get("worker"))[:128]
            self._view.say(f"worker {worker} refused a goal that is out of bounds: {self.refused} so far", warning=True)

    def update(self, update: Update, now: float) -> None:
        """Add the server's answer; `now` is monotonic [s]."""
        if update.lost is not None:
            self._note_loss(update)
            return
        if self._lost:
            self._lost = False
            self._view.say("the server answers again")
        if update.trials:
            rows = [self.progress.add(stored, now) for stored in update.trials]
            self._remember(rows, update.trials)
            self._view.trials(rows, self.progress)
            if not (update.more or self._caught_up):
                self._caught_up = True
                _logger.info("caught up with %d trials, seq %d", sum(self.progress.kinds.values()), self.progress.seq)
        if update.status is not None:
            self._compare(update.status)
            status = update.status
            self._attempt(lambda: self._view.status(status, self.progress, now))

    def step(self, now: float) -> None:
        """Pass on everything that is ready; `now` is monotonic [s]."""
        for result in self.progress.finished_epochs(now):
            self._show_epoch(result)
        for key, telemetry in list(self._waiting.items()):
            trial = self._logged.get(telemetry.seq)
            if trial is None and telemetry.seq > self.progress.seq:
                continue
            del self._waiting[key]
            if trial is None or trial.pictured or (telemetry.seq, trial.worker) in self._waiting:
                self.dropped += 1  # the picture by the worker that the log names goes before others
                continue
            trial.pictured = True
            self._show(trial.row, telemetry)
        self._attempt(lambda: self._view.tick(now, self.progress))

    def _show_epoch(self, result: EpochResult) -> None:
        self._attempt(lambda: self._view.epoch(result, self.progress))

    def _show(self, row: Row, telemetry: Telemetry) -> None:
        self._attempt(lambda: self._view.picture(row, telemetry))

    def finish(self) -> None:
        """Pass on the evaluations that wait for more trials: none will come."""
        for result in self.progress.finished_epochs(math.inf):
            self._show_epoch(result)

    def _remember(self, rows: Sequence[Row], trials: Sequence[StoredTrial]) -> None:
        for row, stored in list(zip(rows, trials, strict=True))[-MAX_REMEMBERED:]:
            self._logged[row.seq] = _LoggedTrial(row, stored.trial.worker)
        while len(self._logged) > MAX_REMEMBERED:
            self._logged.popitem(last=False)

    def _note_loss(self, update: Update) -> None:
        if self._lost or update.lost is None:
            return
        self._lost = True
        quiet = isinstance(update.lost, Unavailable)
        reason = "the server does not answer; waiting for it" if quiet else f"{update.lost.code}: {update.lost.message}"
        self._view.say(reason, warning=True)

    def _compare(self, status: Mapping[str, Any]) -> None:
        seq = status.get("seq")
        if not self._ahead and isinstance(seq, int) and seq < self.progress.seq:
            self._ahead = True
            self._view.say(
                f"the log ends at {seq}, but {self.progress.seq} was seen: another data directory? start watch again",
                warning=True,
            )
