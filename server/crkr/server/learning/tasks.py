"""The tasks of a log by name: those served here, and the names of those served elsewhere."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from itertools import islice
from typing import Final, final

from crkr.protocol import Internal, Invalid, ShuttingDown, UnknownTask
from crkr.server.learning.served_task import ServedTask
from crkr.server.log import Event

__all__ = ["Tasks"]

_MOST_NAMED: Final = 20  # tasks that an error names
_RETRY_MS: Final = 100
_MOST: Final = 20_000  # tasks from which on none is made; each takes 20 kB at least, and time at every start


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
