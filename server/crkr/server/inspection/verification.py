"""Verifies a log: it is complete, and everything derived from it agrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final, final

import numpy as np

from crkr.learner import Kernel, Learner, radii_kdtree, top
from crkr.protocol import CrkrError, NoSamples, StorageError, TaskSpec, Trial, UnknownTask
from crkr.server.learning.radii_cache import load_radii
from crkr.server.learning.restore import batches, restore
from crkr.server.learning.served_task import apply_entries
from crkr.server.log import Corrections, Event, LogReader, Visible

__all__ = ["Verdict", "verify"]

_STATES: Final = 256  # drawn for comparing predictions
_TOLERANCE: Final = 1e-9
_PAGE: Final = 5000
_STEP: Final = 64  # trials a new model while learning as the server does


@final
@dataclass(frozen=True, slots=True)
class Verdict:
    """The result of verifying one task.

    Attributes:
        task: Its name.
        entries: Log positions read, each checked against its digest.
        samples: Trials among them.
        active: Samples in the model.
        model_version: Log position of the model.
        largest_difference: Largest difference of predictions by the restarted and by the served model [scaled].
        problems: Disagreements; empty if there are none.
    """

    task: str
    entries: int
    samples: int
    active: int
    model_version: int
    largest_difference: float
    problems: tuple[str, ...]


def verify(log: LogReader, name: str, progress: Callable[[int], None] = lambda _: None) -> Verdict:
    """Replay a task twice, in one batch as a restart does and step by step as the server did, and compare.

    Args:
        log: Where from.
        name: The task.
        progress: Called with every log position reached.

    Raises:
        StorageError: The log cannot be read to its end.
    """
    try:
        restored = restore(log, name)
    except (StorageError, UnknownTask):
        raise
    except Exception as error:  # the server starts in spite of it; check the other tasks too
        problem = error.message if isinstance(error, CrkrError) else f"{type(error).__name__}: {error}"
        return Verdict(name, log.last(name), 0, 0, 0, 0.0, (f"the task cannot be restored: {problem}",))
    learner, trials = _relearn(log, name, progress)
    problems: list[str] = []
    if learner.active_ids != restored.learner.active_ids:
        problems.append("the active set of a restart is not the one learned step by step")
    problems += _compare_selection(learner, trials, restored.spec)
    problems += _compare_rows(log, name, trials)
    problems += _compare_cache(log, name, restored.learner)
    difference = _difference(restored.learner, learner, restored.created)
    if not difference <= _TOLERANCE:
        problems.append(f"predictions differ by {difference:.2e} of the goals' scales")
    return Verdict(name, restored.seq, len(trials), learner.model.active, learner.version, difference, tuple(problems))


@final
@dataclass(slots=True)
class _Kept:
    """A trial after all events, derived without the learner."""

    trial: Trial
    cost: float | None
    seq: int
    removed: bool = False


def _relearn(log: LogReader, name: str, progress: Callable[[int], None]) -> tuple[Learner, dict[bytes, _Kept]]:
    entries = log.read(name)
    first = next(entries)
    if not isinstance(first, Event):
        raise StorageError(f"the log of task {name!r} does not begin with its creation; restore a backup")
    learner, kept = Learner(TaskSpec.from_dict(first.body["spec"])), dict[bytes, _Kept]()
    visible = Visible.of(log.rollbacks(name), log.last(name))
    for batch in batches(entries, _STEP):
        if isinstance(batch, Event):
            if batch.seq in visible:
                apply_entries(learner, batch)
        elif counted := [entry for entry in batch if entry.seq in visible]:
            apply_entries(learner, counted)
        if not isinstance(batch, Event):
            kept |= {entry.trial.id.bytes: _Kept(entry.trial, entry.trial.cost, entry.seq) for entry in batch}
        elif batch.kind == "recost":
            for one, cost in zip(batch.body["ids"], batch.body["costs"], strict=True):
                kept[one].cost = cost
        elif batch.kind == "remove":
            for one in batch.body["ids"]:
                kept[one].removed = True
        elif batch.kind in ("amend", "rollback"):
            for one, values in zip(batch.body["ids"], batch.body["values"], strict=True):
                changed = {name: values[name] for name in ("success", "kind", "learn")}
                now = replace(kept[one].trial, **changed)
                kept[one] = _Kept(now, values["cost"], kept[one].seq, values["removed"])
        progress(learner.version)
    for one in kept.values():
        one.removed |= one.seq not in visible
    return learner, kept


def _compare_selection(learner: Learner, trials: dict[bytes, _Kept], spec: TaskSpec) -> list[str]:
    """The active set by the batch algorithm over all eligible trials."""
    if spec.selector != "anms":
        return []
    eligible = [kept for kept in trials.values() if _eligible(kept, spec.learn_from)]
    if not eligible:
        return [] if not learner.active_ids else ["samples are active though none is eligible"]
    states = np.array([kept.trial.state for kept in eligible])
    costs = np.array([kept.cost for kept in eligible], dtype=np.float64)
    squared, _ = radii_kdtree(Kernel(spec.centres, spec.lengthscales, 1.0).standardise(states), costs)
    expected = {eligible[row].trial.id for row in top(squared, spec.budget)}
    return [] if expected == set(learner.active_ids) else ["the active set is not the batch algorithm's"]


def _eligible(kept: _Kept, learn_from: str) -> bool:
    return not kept.removed and kept.trial.eligible(learn_from)


def _compare_rows(log: LogReader, name: str, trials: dict[bytes, _Kept]) -> list[str]:
    """Compares the answers of `samples` with the events."""
    corrections = Corrections()
    for event in log.events(name):
        corrections.note(event)
    after: int | None = 0
    wrong = count = 0
    while after is not None:
        entries, after = log.page(name, after, _PAGE, 2**30)
        count += len(entries)
        for entry in map(corrections.present, entries):
            kept = trials[entry["id"]]
            wrong += entry["cost"] != kept.cost or entry.get("removed", False) != kept.removed
            wrong += (entry["kind"], entry["success"]) != (kept.trial.kind, kept.trial.success)
            wrong += entry.get("learn") != kept.trial.learn
    problems = [f"{wrong} samples are served with another cost or mark than the events give"] if wrong else []
    return problems if count == len(trials) else [*problems, f"{count} samples are served, {len(trials)} logged"]


def _compare_cache(log: LogReader, name: str, learner: Learner) -> list[str]:
    cache, truth = load_radii(log, name), learner.radii()
    if cache is None or truth is None or cache.version != truth.version:
        return []
    same = np.array_equal(cache.seqs, truth.seqs) and np.array_equal(cache.squared, truth.squared)
    return [] if same else ["the cached radii are not those of the log; delete them: DROP TABLE cache"]


def _difference(one: Learner, other: Learner, spec: TaskSpec) -> float:
    """The largest difference of goal, mean or deviation over the state box, in scales of the goals."""
    rng = np.random.default_rng(0)
    low, high = (np.array([getattr(axis, end) for axis in spec.state]) for end in ("low", "high"))
    share = rng.uniform(size=(_STATES, len(spec.state)))
    states = (1.0 - share) * low + share * high  # the difference might overflow
    try:
        answers: list[Any] = [learner.model.predict(states) for learner in (one, other)]
    except NoSamples:
        return 0.0
    except CrkrError:  # a task that refuses novel states is compared where it answers
        states = np.array(one.model.states)
        answers = [learner.model.predict(states) for learner in (one, other)]
    first, second = answers
    pairs = [(getattr(first, name), getattr(second, name)) for name in ("goals", "means", "sigmas")]
    return max(float(np.max(np.abs(a - b) / spec.scales)) for a, b in pairs)
