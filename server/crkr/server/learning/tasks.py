"""The tasks in service. Each has one learner, changed by one thread, and one model, read by all threads."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import islice
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.learner import Advice, Learner, Model, TrialColumns, advise
from crkr.protocol import KINDS, Internal, Invalid, ShuttingDown, TaskSpec, UnknownTask, pack, task_id
from crkr.server.log import Corrections, Event, LoggedTrial
from crkr.server.thread_faults import FAULTS

__all__ = ["ServedTask", "Tasks", "apply_entries", "hyperparameters"]

logger = logging.getLogger(__name__)

_MOST_NAMED: Final = 20  # tasks that an error names
_RETRY_MS: Final = 100
_MOST: Final = 20_000  # tasks from which on none is made; each takes 20 kB at least, and time at every start


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


@final
class Tasks:
    """All tasks of the log by name: those served here, and the names of those served elsewhere.

    The writer changes the tasks, and membership adds to them and notes the names, each as a whole. Readers need no
    lock: dictionaries are copied atomically.

    Args:
        moves: Renames and deletions of the log.
        most: Tasks from which on none is made; more are served if the log has them.

    Attributes:
        creates: Whether this server creates new tasks.
    """

    def __init__(self, moves: Iterable[Event] = (), most: int = _MOST) -> None:
        self._most = most
        self._lock = threading.Lock()  # of every change
        self._by_name: dict[str, ServedTask] = {}
        # Names of the log, in order, with those served here; empty where no other server serves.
        self._listed: dict[str, None] = {}
        self.creates = True
        self._moves: dict[tuple[str, str, bytes], Event] = {}
        self._former: set[str] = set()
        self.note_moves(moves)

    def check_room(self) -> None:
        """Raises `Invalid` if there are too many tasks to make another."""
        if len(self) >= self._most:
            raise Invalid(
                f"{len(self)} tasks are there already, and a server makes at most {self._most}: delete one that is not "
                "needed (crkr delete), or start another server with a log of its own",
                details={"most": self._most},
            )

    def add(self, task: ServedTask) -> None:
        """Put a task into service."""
        with self._lock:
            self._by_name[task.name] = task
            if self._listed:
                self._listed[task.name] = None

    def move(self, before: str, event: Event) -> None:
        """Rename a task in its place, or take it out of service."""
        named = {before: event.body["name"] if event.kind == "rename" else None}
        with self._lock:
            found = [(named.get(key, key), task) for key, task in self._by_name.items()]
            self._by_name = {key: task for key, task in found if key is not None}
            listed = (named.get(key, key) for key in self._listed)
            self._listed = {key: None for key in listed if key is not None}
        self.note_moves([event])

    def note_moves(self, moves: Iterable[Event]) -> None:
        """Remember renames and deletions, whose requests may be repeated."""
        for event in moves:
            if "request" in event.body:
                self._former.add(event.body["was"])
                self._moves[event.kind, event.body["was"], event.body["request"]] = event

    def moved(self, verb: str, name: str, request: object) -> Event | None:
        """The earlier result of this request, by its id; None for one that is new or has no id."""
        return self._moves.get((verb, name, request)) if isinstance(request, bytes) else None

    def leave(self, name: str) -> None:
        """Take a task out of service that another server will serve."""
        with self._lock:
            listed = self._listed or dict.fromkeys(self._by_name)
            self._listed = {**listed, name: None}  # first, so that one of both always knows it
            self._by_name = {key: task for key, task in self._by_name.items() if key != name}

    def note_names(self, names: Iterable[str]) -> None:
        """Note the names of all tasks of the log, oldest first; none if no other server serves."""
        listed = dict.fromkeys(names)
        with self._lock:
            self._listed = {**listed, **dict.fromkeys(self._by_name)} if listed else listed

    def is_elsewhere(self, name: str) -> bool:
        """Whether another server serves the task, or will soon."""
        return name in self._listed and name not in self._by_name

    def names(self) -> list[str]:
        """Names of all tasks, oldest first."""
        return list(self._listed or self._by_name)

    def find(self, name: str) -> ServedTask | None:
        """The task, or None; raises `Internal` for one that could not be restored."""
        return self.get(name) if name in self._by_name else None

    def get(self, name: str) -> ServedTask:
        """The task.

        Raises:
            UnknownTask: No task has that name.
            Internal: It could not be restored.
        """
        task = self._by_name.get(name)
        if task is None or not task.restored:
            task = self.look(name)
            raise Internal(
                f"task {name!r} cannot be restored from its log, whose trials can still be read (crkr export): "
                f"{task.fault}",
                details={"task": name, "fault": task.fault},
            )
        return task

    def look(self, name: str) -> ServedTask:
        """The task, restored or not, to read stored data.

        Raises:
            UnknownTask: No task has that name.
            ShuttingDown: Another server serves it, or will soon.
        """
        task = self._by_name.get(name)
        if task is None and self.is_elsewhere(name):
            raise ShuttingDown(f"another server serves task {name!r}: ask again", retry_ms=_RETRY_MS)
        if task is None:
            names = self._listed or self._by_name
            known = ", ".join(list(islice(names, _MOST_NAMED))) or "none yet"
            more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
            raise UnknownTask(
                f"no task {name!r} here; there are: {known}{more}; crkr create makes one", details={"task": name}
            )
        return task

    def look_back(self, name: str) -> None:
        """Raises `UnknownTask` for a name that no task has or had; requests to a former name may be repeats."""
        if name not in self._former:
            self.look(name)

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def __len__(self) -> int:
        return len(self._listed or self._by_name)

    def page(self, after: int, limit: int) -> tuple[list[str], int | None]:
        """At most `limit` names past the first `after`, oldest first, and the next `after` (None at the end)."""
        names, end = self.names(), after + limit
        return names[after:end], end if end < len(names) else None

    def faults(self) -> dict[str, str]:
        """Faulty tasks by name, with the fault."""
        return {task.name: task.fault for task in self.all() if task.fault}

    def all(self) -> list[ServedTask]:
        """Every task served here, oldest first, faulty ones included."""
        return list(self._by_name.values())


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
