"""The run so far, counted from the log's trials in the order of their seq."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any, Final, final

from crkr.client.tally import Tally, stated_epoch, success_by_criterion
from crkr.dashboard.predictions import PredictionRecord
from crkr.protocol import StoredTrial

__all__ = ["PACE_S", "WINDOW", "EpochResult", "Pace", "Progress", "Row", "Window"]

WINDOW: Final = 50  # training trials in a running mean: the paper's epoch
QUIET_S: Final = 3.0  # time without a new ball after which an evaluation is over
MAX_EPOCHS: Final = 2000  # evaluations kept; the oldest finished ones are dropped
PACE_S: Final = 60.0  # over which trials per second are counted
MOST_TIMES: Final = 4096
MAX_NAMES: Final = 24  # reasons, criteria and workers; later ones count as "other"


@final
@dataclass(frozen=True, slots=True)
class Row:
    """One trial of the log and its place in the run.

    Attributes:
        stored: The trial.
        seq: Its log position.
        trial: Training trials (kinds trial and failed) up to and including this one.
        epoch: Its epoch; for an epoch's evaluation the epoch that it closes.
        kind: The protocol's kind.
        worker: The worker that reported it, "" if unknown.
        cost: In [0, 1], or None.
        success: Whether it succeeded.
        reason: How it ended, in the skill's words.
        outcomes: Success by criterion, e.g. {"paper": True, "strict": False}.
        mean_cost: Training trials only: mean cost of the last 50 of them, or None.
        rates: Training trials only: success rate of the last 50 of them by criterion.
        shares: Training trials only: share of the last 50 of them by reason.
        predictions: Training trials only: predictions and results of the last 200 of them.
    """

    stored: StoredTrial
    seq: int
    trial: int
    epoch: int
    kind: str
    worker: str
    cost: float | None
    success: bool
    reason: str
    outcomes: Mapping[str, bool]
    mean_cost: float | None = None
    rates: Mapping[str, float] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    predictions: Mapping[str, float] = field(default_factory=dict)


@final
@dataclass(slots=True)
class EpochResult:
    """One epoch's evaluation.

    Attributes:
        epoch: Which.
        trial: Training trials that the model had learned from which played the first ball.
        tally: Evaluation trials so far.
        last_seen: When the last one was counted, monotonic [s].
        closed: Whether it was returned as finished.
    """

    epoch: int
    trial: int
    tally: Tally = field(default_factory=Tally)
    last_seen: float = 0.0
    closed: bool = False

    @property
    def balls(self) -> int:
        """Evaluation trials so far."""
        return self.tally.trials


@final
class Window:
    """Costs, outcomes and reasons of the newest `size` trials; the time to add one does not grow."""

    def __init__(self, size: int) -> None:
        self._entries: deque[tuple[float | None, Mapping[str, bool], str]] = deque()
        self._size = size
        self._tally = Tally()
        self.reasons: Counter[str] = Counter()

    def add(self, cost: float | None, outcomes: Mapping[str, bool], reason: str) -> None:
        """Add a trial, and remove the oldest from a full window."""
        if len(self._entries) == self._size:
            _, met, gone = self._entries.popleft()
            self._tally.remove(met)
            self.reasons[gone] -= 1
        self._entries.append((cost, outcomes, reason))
        self._tally.add(outcomes)
        self.reasons[reason] += 1

    def __len__(self) -> int:
        return len(self._entries)

    def rate(self, criterion: str) -> float | None:
        """Success rate over the trials judged by a criterion; None without any."""
        return self._tally.rate(criterion) if self._tally.judged[criterion] else None

    def share(self, reason: str) -> float:
        """Share of trials that ended for a reason."""
        return self.reasons[reason] / len(self._entries) if self._entries else 0.0

    def mean_cost(self) -> float | None:
        """Mean cost of the trials that have one; None without any."""
        costs = [cost for cost, _, _ in self._entries if cost is not None]
        return sum(costs) / len(costs) if costs else None


@final
class Pace:
    """Training trials per second by the times at which the server stored them.

    It is also right for a display that joins late and reads a long log at once, and falls to 0 after the end.
    """

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=MOST_TIMES)
        self._first: float | None = None

    def add(self, moment: float) -> None:
        """Note a training trial and when it was stored [unix s]."""
        self._first = moment if self._first is None else self._first
        self._times.append(moment)

    def rate(self, now: float) -> float:
        """The rate over the last minute [1/s].

        Args:
            now: The present time by the server's clock [unix s].
        """
        recent = list(takewhile(lambda moment: moment > now - PACE_S, reversed(self._times)))
        if not recent or self._first is None:
            return 0.0
        begun = recent[-1] if len(recent) == MOST_TIMES else max(now - PACE_S, self._first)
        return len(recent) / max(now - begun, 1.0)


@final
class Progress:
    """Counts of a run; each trial is added once, in the order of seq.

    Args:
        running: Whether rows carry means over the last 50 trials.

    Attributes:
        seq: Log position of the newest.
        trials: Training trials (kinds trial and failed).
        epoch: The epoch that training trials belong to now.
        kinds: Trials by kind.
        workers: Trials by worker.
        reasons: Training trials by how they ended.
        criteria: Names of what counts as success, in order of appearance.
        epochs: Evaluations by epoch; one that states no epoch was made by hand and counts by kind only.
        window: The last 50 training trials.
        pace: How quickly they come.
        predictions: Predictions and results of the last 200 training trials.
    """

    def __init__(self, *, running: bool = True) -> None:
        self._running = running
        self.seq = 0
        self.trials = 0
        self.epoch = 0
        self.kinds: Counter[str] = Counter()
        self.workers: Counter[str] = Counter()
        self.reasons: Counter[str] = Counter()
        self.criteria: list[str] = []
        self.epochs: dict[int, EpochResult] = {}
        self.window = Window(WINDOW)
        self.pace = Pace()
        self.predictions = PredictionRecord()
        self._training = array("q")  # log positions of the training trials: 8 bytes each, also after a million

    def add(self, stored: StoredTrial, now: float) -> Row:
        """Count one trial.

        Args:
            stored: The trial; its seq is above all before.
            now: Monotonic time [s].
        """
        trial, info = stored.trial, stored.trial.info
        trains = trial.kind in ("trial", "failed")
        self.seq = stored.seq
        if trains:
            self.trials += 1
            self.pace.add(stored.time)
            self._training.append(stored.seq)
        self.kinds[trial.kind] += 1
        worker = _known(self.workers, trial.worker or "")
        self.workers[worker] += 1
        outcomes = self._outcomes(info, trial.success)
        reason = _known(self.reasons, _reason(trial.kind, trial.success, info))
        stated = stated_epoch(info)
        epoch = self.epoch if stated is None else stated
        if trial.kind == "evaluation" and stated is not None:
            self._evaluate(epoch, self._known_to(trial.model_version), outcomes, now)
        if trains:
            self.reasons[reason] += 1
            self.window.add(trial.cost, outcomes, reason)
            self.predictions.add(trial)
        means = self._means() if trains and self._running else ()
        told = (stored.seq, self.trials, epoch, trial.kind, worker, trial.cost, trial.success, reason, outcomes)
        return Row(stored, *told, *means)

    def _means(self) -> tuple[float | None, dict[str, float], dict[str, float], dict[str, float]]:
        rates = {name: rate for name in self.criteria if (rate := self.window.rate(name)) is not None}
        shares = {name: self.window.share(name) for name in self.reasons}
        return self.window.mean_cost(), rates, shares, self.predictions.shares()

    def finished_epochs(self, now: float) -> list[EpochResult]:
        """Evaluations that are newly complete: as many balls as the one before, or no new ball for some seconds."""
        return self._close_epochs(lambda result: now - result.last_seen > QUIET_S)

    def followed_epochs(self) -> list[EpochResult]:
        """The same for a log that is read at once: as many balls as the one before, or two later ones have begun.

        Several workers may start the next evaluation while the last balls of one are in play.
        """
        newest = sorted(self.epochs)[-2:]
        return self._close_epochs(lambda result: result.epoch < newest[0])

    def _close_epochs(self, is_over: Callable[[EpochResult], bool]) -> list[EpochResult]:
        finished = []
        complete = 0
        for result in sorted(self.epochs.values(), key=lambda result: result.epoch):
            if not result.closed and (is_over(result) or 0 < complete <= result.balls):
                result.closed = True
                finished.append(result)
            complete = result.balls if result.closed else complete
        return finished

    def _known_to(self, model_version: int | None) -> int:
        """Training trials up to a model's log position; all so far if the position is unknown."""
        return self.trials if model_version is None else bisect_right(self._training, model_version)

    def _evaluate(self, epoch: int, trial: int, outcomes: Mapping[str, bool], now: float) -> None:
        if epoch not in self.epochs and len(self.epochs) >= MAX_EPOCHS:
            closed = min((each for each, result in self.epochs.items() if result.closed), default=min(self.epochs))
            del self.epochs[closed]
        result = self.epochs.setdefault(epoch, EpochResult(epoch, trial))
        result.tally.add(outcomes)
        result.last_seen = now
        self.epoch = max(self.epoch, epoch + 1)

    def _outcomes(self, info: Mapping[str, Any], success: bool) -> dict[str, bool]:
        """Success by criterion, for as many as the tables hold."""
        outcomes = {name[:32]: met for name, met in success_by_criterion(success, info).items()}
        for name in outcomes:
            if name not in self.criteria and len(self.criteria) < MAX_NAMES:
                self.criteria.append(name)
        return {name: met for name, met in outcomes.items() if name in self.criteria}


def _known(names: Counter[str], name: str) -> str:
    return name if name in names or len(names) < MAX_NAMES else "other"


def _reason(kind: str, success: bool, info: Mapping[str, Any]) -> str:
    given = info.get("reason")
    if isinstance(given, str) and given:
        return given[:48]
    return "success" if success else "failed" if kind == "failed" else "no success"
