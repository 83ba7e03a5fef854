"""The processes of a launcher: started, listened to, and ended."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, Final, final

from crkr.sim_worker.supervisor.pipe import Line, LineClosed
from crkr.sim_worker.supervisor.stop_request import ctrl_c_blocked

__all__ = ["Fleet", "Member"]

FINISH_S: Final = 2.0
"""A member that was told to stop may finish its trial for this long [s]."""
TERMINATE_S: Final = 1.0
"""One that was terminated is killed after this [s]."""


@final
@dataclass(slots=True, eq=False)
class Member:
    """One process as its launcher sees it.

    Attributes:
        name: For people.
        process: The process.
        line: Our end of the line to it.
        tickets: Trials that it may still do or has under way.
        reason: Why it ended, if it said so.
        silent_s: How long it had made no progress when it was given up, or None [s].
    """

    name: str
    process: SpawnProcess
    line: Line
    tickets: int = 0
    reason: str | None = None
    silent_s: float | None = None

    def order(self, order: str, **fields: Any) -> None:
        """Sends an order; one that cannot arrive is no loss, since the process's end will be seen."""
        try:
            self.line.send({"order": order, **fields})
        except LineClosed:
            return

    def give_up(self, silent_s: float) -> None:
        """Kills it, whatever it is doing; its end is seen as any other."""
        self.silent_s = silent_s
        self.process.kill()

    def ending(self) -> str:
        """How it ended, in words."""
        code = self.process.exitcode
        if self.silent_s is not None:
            return f"made no progress for {self.silent_s:.0f} s and was killed"
        if self.reason is not None:
            return f"ended: {self.reason}"
        if code is not None and code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with status {code}"


@final
class Fleet:
    """Starts processes by the spawn method and hears from them; ends them all when left.

    They are shielded from the terminal's Ctrl-C, which reaches the whole foreground group: the launcher decides when
    they end.
    """

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._members: list[Member] = []

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def start(self, name: str, body: Callable[[Any, Connection], None], settings: object) -> Member:
        """Starts `body(settings, connection)` in a process of its own."""
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=body, args=(settings, theirs), name=name)
        with ctrl_c_blocked():
            process.start()
        theirs.close()  # so that the member's end is also the line's
        member = Member(name, process, Line(ours))
        self._members.append(member)
        return member

    def events(self, timeout_s: float) -> Iterator[tuple[Member, dict[str, Any] | None]]:
        """What happened within `timeout_s`: events of members, and None for the end of one, after its last words."""
        ready = wait([item for member in self._members for item in _handles(member)], timeout_s)
        for member in list(self._members):
            if any(handle in ready for handle in _handles(member)):
                yield from self._listen(member)

    def _listen(self, member: Member) -> Iterator[tuple[Member, dict[str, Any] | None]]:
        try:
            while (event := member.line.receive(0.0)) is not None:
                yield member, event
        except LineClosed:
            member.process.join(TERMINATE_S)  # the line ends a moment before the process does
            if member.process.exitcode is None:
                member.process.kill()
                member.process.join()
        if member.process.exitcode is not None:
            self._members.remove(member)
            member.line.close()
            yield member, None

    def stop(self) -> list[tuple[Member, dict[str, Any]]]:
        """Ends all members: politely, then firmly, then for certain; within 4 s. Gives their last events."""
        members = list(self._members)
        for member in members:
            member.order("stop")
        self._join(FINISH_S)
        for member in self._members:
            member.process.terminate()
        self._join(TERMINATE_S)
        for member in self._members:
            member.process.kill()
        self._join(TERMINATE_S)
        self._members.clear()
        last = [(member, event) for member in members for event in _rest(member)]
        for member in members:
            member.line.close()
        return last

    def _join(self, patience_s: float) -> None:
        deadline = time.monotonic() + patience_s
        for member in self._members:
            member.process.join(max(0.0, deadline - time.monotonic()))
        self._members = [member for member in self._members if member.process.exitcode is None]


def _rest(member: Member) -> Iterator[dict[str, Any]]:
    """What is left on the line of a member that has ended."""
    try:
        while (event := member.line.receive(0.0)) is not None:
            yield event
    except LineClosed:
        return


def _handles(member: Member) -> tuple[Any, Any]:
    return member.line.connection, member.process.sentinel
