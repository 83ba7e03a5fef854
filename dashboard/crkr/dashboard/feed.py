"""Joins what the log holds with what the workers publish, and tells a view.

The log is the truth about trials: every one is told once and in order, also those from before the display was started,
and a lost publication or a restarted server costs no point of a curve. Publications add what the log does not hold:
poses, widths, durations. A picture waits until its trial was read from the log, half a second as a rule.
"""

from __future__ import annotations

import logging
import math
from collections import OrderedDict, deque
from collections.abc import Mapping
from typing import Any, Final, final

from crkr.dashboard.poller import News
from crkr.dashboard.progress import Progress, Row
from crkr.dashboard.telemetry import Telemetry
from crkr.dashboard.view import View
from crkr.protocol import Invalid, Unavailable

__all__ = ["Feed"]

_logger = logging.getLogger(__name__)
MAX_WAITING: Final = 512
MAX_REMEMBERED: Final = 4096


@final
class Feed:
    """Turns news and publications into calls of a view.

    Args:
        view: What to tell.

    Attributes:
        progress: The run so far.
        skipped: Publications that could not be read.
        refused: Goals that workers would not try.
        dropped: Pictures that waited too long for their trial.
    """

    def __init__(self, view: View) -> None:
        self.progress = Progress()
        self.skipped = 0
        self.refused = 0
        self.dropped = 0
        self._view = view
        self._rows: OrderedDict[int, Row] = OrderedDict()
        self._waiting: deque[Telemetry] = deque()
        self._lost = False
        self._ahead = False
        self._caught_up = False

    def publication(self, topic: str, message: Mapping[str, Any]) -> None:
        """Takes one publication; one that cannot be read is counted and skipped."""
        if topic not in ("trial", "evaluation"):
            return
        if message.get("kind") == "failed" and "seq" not in message:
            self._note_refusal(message)
            return
        try:
            self._waiting.append(Telemetry.from_wire(message))
        except Invalid as error:
            self.skipped += 1
            # The first few say what is wrong; a flood of them must not fill the log.
            if self.skipped <= 3 or self.skipped % 1000 == 0:
                self._view.say(f"skipped {self.skipped} unreadable publications: {error.message}", warning=True)
        if len(self._waiting) > MAX_WAITING:
            self._waiting.popleft()
            self.dropped += 1

    def _note_refusal(self, message: Mapping[str, Any]) -> None:
        """A goal that a worker would not try; the log has no such trial."""
        self.refused += 1
        if self.refused <= 3 or self.refused % 1000 == 0:
            worker = str(message.get("worker"))[:128]
            self._view.say(f"worker {worker} refused a goal that is out of bounds: {self.refused} so far", warning=True)

    def news(self, news: News, now: float) -> None:
        """Takes what the server answered; `now` is monotonic [s]."""
        if news.lost is not None:
            self._note_loss(news)
            return
        if self._lost:
            self._lost = False
            self._view.say("the server answers again")
        if news.trials:
            rows = [self.progress.add(stored, now) for stored in news.trials]
            self._remember(rows)
            self._view.trials(rows, self.progress)
            if not (news.more or self._caught_up):
                self._caught_up = True
                _logger.info("caught up with %d trials, seq %d", sum(self.progress.kinds.values()), self.progress.seq)
        if news.status is not None:
            self._compare(news.status)
            self._view.status(news.status, self.progress, now)

    def step(self, now: float) -> None:
        """Passes on what became ready; `now` is monotonic [s]."""
        for result in self.progress.finished_epochs(now):
            self._view.epoch(result, self.progress)
        later: deque[Telemetry] = deque()
        for telemetry in self._waiting:
            row = self._rows.get(telemetry.seq)
            if row is not None:
                self._view.picture(row, telemetry)
            elif telemetry.seq > self.progress.seq:
                later.append(telemetry)
            else:
                self.dropped += 1
        self._waiting = later
        self._view.tick(now, self.progress)

    def finish(self) -> None:
        """Passes on evaluations that were still waiting for more trials: none will come."""
        for result in self.progress.finished_epochs(math.inf):
            self._view.epoch(result, self.progress)

    def _remember(self, rows: list[Row]) -> None:
        for row in rows[-MAX_REMEMBERED:]:
            self._rows[row.seq] = row
        while len(self._rows) > MAX_REMEMBERED:
            self._rows.popitem(last=False)

    def _note_loss(self, news: News) -> None:
        if self._lost or news.lost is None:
            return
        self._lost = True
        quiet = isinstance(news.lost, Unavailable)
        reason = "the server does not answer; waiting for it" if quiet else f"{news.lost.code}: {news.lost.message}"
        self._view.say(reason, warning=True)

    def _compare(self, status: Mapping[str, Any]) -> None:
        seq = status.get("seq")
        if not self._ahead and isinstance(seq, int) and seq < self.progress.seq:
            self._ahead = True
            self._view.say(
                f"the log ends at {seq}, but {self.progress.seq} was seen: another data directory? start watch again",
                warning=True,
            )
