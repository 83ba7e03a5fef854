"""A task in service, its learner and its present model, and how entries of the log reach the learner."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner import Advice, Learner, Model, TrialColumns, advise
from crkr.protocol import KINDS, Internal, TaskSpec, pack, task_id
from crkr.server.log import Corrections, Event, LoggedTrial
from crkr.server.thread_faults import FAULTS

__all__ = ["ServedTask", "apply_entries", "hyperparameters"]

logger = logging.getLogger(__name__)


@final
class ServedTask:
    """A task in service.

    The writer changes `seq`, `agreed`, `changed`, `configured`, `archived` and the counts at a commit. The learning
    thread changes `learner`, `model`, `spec` and `eligible`. Either notes a `fault`. `model` is replaced as a whole:
    readers need no lock.

    Attributes:
        created: The specification as created.
        dimensions: d.
        learner: Used by the learning thread, and by the replay before it starts.
        model: The policy that answers predictions.
        spec: The specification in force.
        agreed: The specification in the log; newer than `spec` while learning lags behind.
        seq: Last committed log position.
        changed: Log position of the last event.
        configured: Log position of the last change of its settings.
        archived: Whether only reads are answered.
        deleted: Whether nothing is answered; the log keeps the task under another name until it is purged.
        samples: Stored trials by kind as reported, removed ones included.
        corrections: The corrections of stored trials.
        rests: Until when the next trials wait for others [s, monotonic], unless their worker is that of the last trial.
        eligible: Number of trials that may be learned from.
        fault: Why learning stopped; "" while it runs.
        restarting: Whether a logged restart of its outcome model is not learned yet.
        drift: How far outcomes are from their predictions; None where outcomes are not modelled.
        history: All trials that the learner has seen.
        restored: Whether the log was replayed to its end. If not, `fault` says why, and only stored data can be read.
        damage: A damaged row that no prediction depends on; "" without one.
        log_id: Identifies the log that begins with this task's creation, on any server.
    """

    __slots__ = (
        "_packed",
        "agreed",
        "archived",
        "changed",
        "configured",
        "corrections",
        "created",
        "damage",
        "deleted",
        "dimensions",
        "drift",
        "eligible",
        "fault",
        "history",
        "learner",
        "log_id",
        "model",
        "restarting",
        "restored",
        "rests",
        "samples",
        "seq",
        "spec",
    )

    def __init__(self, spec: TaskSpec) -> None:
        self.created = spec
        self.dimensions: Final = len(spec.state)
        self.learner = Learner(spec)
        self.drift = self.learner.drift
        self.history = self.learner.history
        self.model: Model = self.learner.model
        self.spec = self.agreed = spec
        self.seq = self.changed = self.configured = 1
        self.archived = self.deleted = False
        self.samples: Counter[str] = Counter()
        self.corrections: Final = Corrections()
        self.eligible = 0
        self.rests: tuple[float, str | None] = (0.0, None)
        self.fault = self.damage = ""
        self.restored = True
        self.restarting = False
        self.log_id = UUID(int=0)
        self._packed: tuple[TaskSpec, bytes] | None = None

    @property
    def name(self) -> str:
        """Its name in keys."""
        return self.created.name

    def begin(self, creation: Event) -> None:
        """Note the creation event."""
        self.log_id = task_id(creation.body["spec"]["name"], f"log/{creation.time.hex()}")

    def packed_spec(self) -> bytes:
        """The specification in force, encoded once per change."""
        spec, known = self.spec, self._packed
        if known is None or known[0] is not spec:
            known = self._packed = spec, pack(spec.to_dict())
        return known[1]

    def note(self, entry: LoggedTrial | Event) -> None:
        """Count a committed entry."""
        self.seq = entry.seq
        if isinstance(entry, LoggedTrial):
            self.samples[entry.trial.kind] += 1
            return
        self.changed = entry.seq
        self.corrections.note(entry)
        if entry.kind == "archive":
            self.archived = True
        elif entry.kind == "configure":
            self.configured = entry.seq
            self.agreed = self.agreed.with_changes(entry.body["changes"])
        elif entry.kind == "rollback":
            self.configured = entry.seq
            self.agreed = replace(TaskSpec.from_dict(entry.body["spec"]), name=self.name)
        elif entry.kind == "rename":
            self.deleted = False  # where it was deleted before
            self.created, self.agreed = (replace(spec, name=entry.body["name"]) for spec in (self.created, self.agreed))
        elif entry.kind == "delete":
            self.deleted = True

    def note_all(self, entries: Sequence[LoggedTrial | Event]) -> None:
        """Count committed entries that are to be learned; learning stops if that fails."""
        try:
            for entry in entries:
                self.note(entry)
        except BaseException as error:
            self.stop_learning(error)

    def note_columns(self, columns: TrialColumns) -> None:
        """Count committed trials."""
        self.seq = int(columns.seqs[-1])
        for kind, count in zip(KINDS, np.bincount(columns.kinds, minlength=len(KINDS)).tolist(), strict=True):
            self.samples[kind] += count

    def advice(self) -> list[Advice]:
        """What limits learning, and what to do about it; computed at each call in some 0.1 ms."""
        return advise(self.spec, self.history, self.drift, self.eligible, self.model.active)

    def stop_learning(self, error: BaseException) -> Internal:
        """Note the first fault, after which nothing is learned until a restart; returns the answer to who waits."""
        if not isinstance(error, Exception):  # also a panic: only this task stops
            FAULTS.note(error)
        if not self.fault:
            self.fault = type(error).__name__  # first, as what follows takes memory
            self.fault = f"{type(error).__name__}: {error}"
            logger.error("task %r stops learning after log position %s", self.name, self.model.version, exc_info=error)
        return Internal(f"task {self.name!r} stores trials but learns no more until a restart: {self.fault}")

    def publish(self) -> None:
        """Let the learner's present model answer predictions."""
        self.drift, self.history = self.learner.drift, self.learner.history
        self.spec, self.model, self.eligible = self.learner.spec, self.learner.model, self.learner.eligible


def hyperparameters(model: Model) -> dict[str, Any]:
    """The numbers of a model's kernel, fitted or given."""
    kernel = model.parameters.kernel
    return {
        "lengthscales": kernel.lengthscales,
        "signal_variance": kernel.signal_variance,
        "linear_weight": kernel.linear_weight,
    }


def apply_entries(learner: Learner, entries: Sequence[LoggedTrial] | Event) -> Any:
    """Apply trials, or one event, at their log positions, live or replayed; returns the learner's result."""
    if not isinstance(entries, Event):
        return learner.apply_trials([entry.seq for entry in entries], [entry.trial for entry in entries])
    body, seq = entries.body, entries.seq
    match entries.kind:
        case "recost":
            return learner.apply_recost(seq, body["ids"], body["costs"])
        case "remove":
            return learner.apply_remove(seq, body["ids"])
        case "amend":
            return learner.apply_amend(seq, body["ids"], body["values"])
        case "configure":
            return learner.apply_configure(seq, body["changes"])
        case "fit":
            return learner.apply_fit(seq, body["lengthscales"], body["signal_variance"])
        case "restart":
            return learner.apply_restart(seq)
        case "rename":
            return learner.apply_rename(seq, body["name"])
        case "rollback":  # hidden entries are not applied; a newer name stays
            return learner.apply_rename(seq, body["spec"]["name"])
        case "archive" | "delete":
            return learner.apply_configure(seq, {})  # advances the position only
        case "create":  # the learner was rebuilt from it
            return None
    raise Internal(f"log position {seq} holds an event of kind {entries.kind!r}, which this version does not know")
