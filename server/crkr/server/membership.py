"""A server's membership of a group that shares a log: the tasks it takes, and those it hands over.

The server with the fewest tasks, or the first to come among equals, takes a task without a living owner. A server with
more than its share hands its newest tasks over. All servers see the same rows, and the epoch in a task's row decides
when two take it at once.

The servers' routers are linked, so that a question reaches all servers from anywhere; those that do not own its task
stay silent. A server that does not see the token of an earlier one for a whole lease, while its row lives, stops
serving: a link is cut, and its clients would not reach the other's tasks.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any, Final, final

import zenoh

from crkr.protocol import CrkrError, ShuttingDown, StorageError, UnknownTask, encoding, pack, rpc_key, unpack
from crkr.protocol.keys import live_peer_key
from crkr.server.learning.restore import restored
from crkr.server.learning.served_task import ServedTask
from crkr.server.learning.tasks import Tasks
from crkr.server.log import DELETED
from crkr.server.log.postgres.lease import LEASE_S, Member, Roster, TaskRow
from crkr.server.log.postgres.log import PostgresLog
from crkr.server.queries.refusals import Refuser
from crkr.server.queries.request import Request
from crkr.server.thread_faults import keep_running

__all__ = ["Membership"]

logger = logging.getLogger(__name__)

_PAUSE_S: Final = 0.02  # between attempts to join, and between looks for unknown tasks
_PATIENCE_S: Final = 0.5  # for an answer of the other servers, and for news of the lease
_DESCRIBE_S: Final = 1.0  # between descriptions of the tasks for the other servers
_TOGETHER: Final = 8  # tasks taken at a time
_MOST_UNKNOWN: Final = 256  # requests for unknown tasks that wait for a look at the log


@final
class Membership:
    """Takes tasks and hands them over on its own thread, and keeps the lease.

    Attributes:
        zenoh_id: The id of the server's session, by which clients and servers know it.
        described: Returns other servers' descriptions of tasks, by name.
    """

    def __init__(self, log: PostgresLog, lost: Callable[[str], None]) -> None:
        self.zenoh_id: Final = log.lease.me.hex
        self.described: Final = log.described
        self._log, self._lease, self._lost = log, log.lease, lost
        self._tasks = Tasks()
        self._hand_over: Callable[[str, Callable[[ServedTask], None]], None] = lambda *_: None
        self._ready: Callable[[ServedTask], None] = lambda _: None
        self._entry: Callable[[ServedTask], bytes] = lambda _: b""
        self._refuser = Refuser()
        self._news, self._stopped = threading.Event(), threading.Event()
        self._serving: Sequence[Member] = ()
        self._epoch = -1  # epoch of the roster for which the tasks were read
        self._leaving: set[str] = set()
        self._unknown: deque[Request] = deque()
        self._session: zenoh.Session | None = None
        self._held: list[Any] = []  # declarations
        self._seen: dict[str, float] = {}  # when each server's token was last seen [s, monotonic]
        self._tokens: set[str] = set()
        self._described: dict[str, tuple[object, ...]] = {}
        self._describe_at = 0.0
        self._thread = threading.Thread(target=keep_running, args=(self._step,), name="membership", daemon=True)
        log.keep(lost, self._news.set)

    def servers(self) -> list[str]:
        """Zenoh ids of the servers that share the tasks."""
        return [member.id.hex for member in self._serving]

    def positions(self) -> int:
        """The largest number of log positions that this server saw."""
        return self._lease.positions

    def watch(self, session: zenoh.Session) -> None:
        """Show this server's token in a session, and watch those of others."""
        self._session = session
        self._tokens.clear()
        tokens = session.liveliness()
        self._held = [
            tokens.declare_token(live_peer_key(self.zenoh_id)),
            tokens.declare_subscriber(live_peer_key("*"), self._note_token, history=True),
        ]

    def join(self, tasks: Tasks) -> None:
        """Join the servers that already serve, and read the list of tasks.

        Args:
            tasks: The tasks that this server owns, and serves once it has joined.

        Raises:
            ShuttingDown: The others are not reached.
        """
        self._tasks = tasks
        deadline = time.monotonic() + LEASE_S
        while True:
            roster = self._lease.look()
            others = {member.id.hex for member in roster.serving} - {self.zenoh_id}
            if len(others) < len(roster.serving):  # this one is among them
                break
            if not others <= self._tokens or not self._lease.join(roster):
                if time.monotonic() > deadline:
                    raise ShuttingDown("the servers that serve are not reached")
                self._stopped.wait(_PAUSE_S)
        self._list(roster.serving)

    def start(
        self,
        hand_over: Callable[[str, Callable[[ServedTask], None]], None],
        ready: Callable[[ServedTask], None],
        entry: Callable[[ServedTask], bytes],
        refuser: Refuser,
    ) -> None:
        """Start to take tasks and to hand them over.

        Args:
            hand_over: Takes a task out of service, and calls back once it is learned.
            ready: Called before it is handed over.
            entry: Describes a task as `tasks` lists it.
            refuser: Answers requests for unknown tasks.
        """
        self._hand_over, self._ready, self._entry, self._refuser = hand_over, ready, entry, refuser
        self._thread.start()

    def stop(self, patience_s: float) -> None:
        """Stop taking and handing over."""
        self._stopped.set()
        self._news.set()
        if self._thread.is_alive():
            self._thread.join(patience_s)

    def look_up(self, request: Request) -> bool:
        """Whether a request for an unknown task waits for a look at the log; not if this server is alone.

        Raises:
            ShuttingDown: Too many wait already.
        """
        if len(self._serving) == 1 and set(self._tokens) <= {self.zenoh_id}:  # a new one's token shows before its entry
            return False
        if len(self._unknown) >= _MOST_UNKNOWN:
            raise ShuttingDown("too many questions about unknown tasks wait already: ask again")
        self._unknown.append(request)
        self._news.set()
        return True

    def _note_token(self, sample: zenoh.Sample) -> None:
        server = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            self._tokens.add(server)
        else:
            self._tokens.discard(server)

    def _step(self) -> bool:
        self._news.wait(_PATIENCE_S)
        self._news.clear()
        if self._stopped.is_set():
            return False
        roster = self._lease.roster
        try:
            if roster is None:
                self._ask_others()
            elif any(member.id == self._lease.me for member in roster.serving):
                self._follow(roster)
        except CrkrError as error:
            logger.debug("the tasks are not shared out: %s", error.message)
            self._epoch = -1
        return True

    def _follow(self, roster: Roster) -> None:
        self._check_links(roster.serving)
        unknown = [self._unknown.popleft() for _ in range(len(self._unknown))]
        if unknown or roster.epoch != self._epoch:
            if unknown:
                self._tasks.note_moves(self._log.reads.moves())
            rows = self._list(roster.serving)
            self._epoch = roster.epoch
            for request in unknown:
                self._refuse(request)
            self._share_out(rows)
        if time.monotonic() >= self._describe_at and len(roster.serving) > 1:
            self._describe()
        if unknown:
            self._stopped.wait(_PAUSE_S)

    def _list(self, serving: Sequence[Member]) -> list[TaskRow]:
        rows = [row for row in self._lease.tasks() if not row.name.startswith(DELETED)]
        alone = len(serving) == 1 and all(row.name in self._tasks for row in rows)
        self._tasks.note_names(() if alone else (row.name for row in rows))
        if {one.id for one in serving} != {one.id for one in self._serving}:  # what another one did may be asked here
            self._tasks.note_moves(self._log.reads.moves())
        self._serving = serving
        owned = Counter(row.owner for row in rows)
        self._tasks.creates = min(serving, key=lambda one: (owned[one.id], one.number)).id == self._lease.me
        return rows

    def _refuse(self, request: Request) -> None:
        """Answers that a task is unknown if the log does not have it; else its server answers.

        Another thread sends it, because a client that does not read must not hold up this one.
        """
        answer: CrkrError = ShuttingDown("it is served by now")
        try:
            (self._tasks.look_back if request.scope == "admin" else self._tasks.look)(request.task)
        except (ShuttingDown, UnknownTask) as error:
            answer = error

        def tell(error: CrkrError) -> None:
            if isinstance(error, UnknownTask):
                request.fail(error)
            request.let_go()  # it is asked again

        if not self._refuser.add(tell, answer, request.held_bytes()):
            request.let_go()

    def _share_out(self, rows: Sequence[TaskRow]) -> None:
        """Take this server's share of the free tasks, or hand over its surplus."""
        me, living = self._lease.me, {member.id for member in self._serving}
        owned = Counter(row.owner for row in rows)
        mine, free = [], 0
        for row in rows:
            if row.owner not in living:
                least = min(self._serving, key=lambda one: (owned[one.id], one.number)).id
                owned[least] += 1
                free += 1
                if least == me:
                    mine.append(row)
            elif row.owner == me and not (row.name in self._leaving or self._log.owns(row.name)):
                mine.append(row)  # made by a commit whose outcome was unknown, or a hand-over failed
        for row in self._lease.take(mine[:_TOGETHER]) if mine else ():
            self._adopt(row)
        if mine:
            self._epoch = -1
            self._news.set()
        elif not free:
            served = [row.name for row in rows if row.owner == me and row.name in self._tasks]
            for name in served[math.ceil(len(rows) / len(living)) :]:
                self._leaving.add(name)
                self._hand_over(name, self._give)

    def _adopt(self, row: TaskRow) -> None:
        began = time.monotonic()
        try:
            task = restored(self._log.reads, row.name)
            if task.seq < row.last:
                raise StorageError(f"the log of task {row.name!r} ends at {task.seq}, and {row.last} were acknowledged")
        except CrkrError as error:
            logger.warning("task %s is not taken: %s", row.name, error.message)
            self._lease.give(row.key, row.epoch)
            self._stopped.wait(_PATIENCE_S)
            return
        self._log.own(row)
        self._tasks.add(task)
        logger.info("took task %s at epoch %d in %.3f s", row.name, row.epoch, time.monotonic() - began)

    def _give(self, task: ServedTask) -> None:
        """Called on a learning thread, once all entries stored here are learned."""
        name = task.name
        try:
            self._ready(task)
            self._log.hand_over(name)
            logger.info("handed task %s over", name)
        except CrkrError as error:
            logger.warning("task %s is not handed over: %s", name, error.message)
        finally:
            self._leaving.discard(name)

    def _describe(self) -> None:
        """Describe this server's tasks for the lists of others."""
        self._describe_at = time.monotonic() + _DESCRIBE_S
        now = {
            task.name: (task, task.model.version, task.spec, task.archived, task.fault) for task in self._tasks.all()
        }
        changed = {name: self._entry(about[0]) for name, about in now.items() if self._described.get(name) != about}
        if changed:
            self._log.describe(changed)
        self._described = dict(now)

    def _check_links(self, serving: Sequence[Member]) -> None:
        now = time.monotonic()
        for member in serving:
            if member.id == self._lease.me:
                return
            if member.id.hex in self._tokens:
                self._seen[member.id.hex] = now
            elif now - self._seen.setdefault(member.id.hex, now) > LEASE_S:
                self._lost(f"the link to the server at {member.address} is cut")
                return

    def _ask_others(self) -> None:
        """Ask whether other servers took the tasks while the database is away from here."""
        others = {member.id.hex for member in self._serving if member.id != self._lease.me}
        if not others or self._session is None:
            return
        replies = self._session.get(
            rpc_key("info"),
            payload=pack({"limit": 0}),
            encoding=encoding("info"),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=_PATIENCE_S,
        )
        for reply in replies:
            if reply.ok is not None and reply.replier_id is not None and str(reply.replier_id.zid) in others:
                serving = unpack(reply.ok.payload.to_bytes()).get("servers", ())
                if serving and self.zenoh_id not in serving:
                    self._lost("another server took its tasks, and the database is away from here")
                    return
