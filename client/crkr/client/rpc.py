"""Calls: a message map out, a message map back, by a deadline."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.client.answer_checks import plain, reading
from crkr.client.transport import Transport
from crkr.protocol import (
    ADMIN_VERBS,
    CrkrError,
    Invalid,
    id_from_wire,
    pack,
    rpc_key,
    unpack,
)
from crkr.protocol.checks import entries, integer

__all__ = ["Rpc", "positive"]

# Verbs whose work may take longer than one ordinary attempt: asking again would only double it.
_PATIENT: Final = frozenset({*ADMIN_VERBS, "create_task", "explain", "model", "samples"})
_MANY: Final = 16  # states or trials of one message, from which on it may take long too
_PAGE: Final = 1000  # tasks


@final
class Rpc:
    """Calls with a default deadline over a transport.

    Attributes:
        transport: What carries them.
        timeout_s: Deadline of a call that names none [s].
    """

    def __init__(self, transport: Transport, timeout_s: float) -> None:
        self.transport: Final = transport
        self.timeout_s: Final = positive(timeout_s)

    def deadline(self, timeout_s: float | None) -> float:
        """The moment to give up [s, monotonic clock]; raises `Invalid` for a time that is not positive."""
        return time.monotonic() + (self.timeout_s if timeout_s is None else positive(timeout_s))

    def call(
        self, key: str, message: Mapping[str, Any], timeout_s: float | None = None, *, optional: bool = False
    ) -> dict[str, Any]:
        """Sends a message and returns the answer; the verb is the key's last word. For `optional` see `exchange`.

        Raises:
            Unavailable: No answer in time.
            CrkrError: The server's typed error, or `Internal` for an answer that cannot be read.
        """
        verb = key.rpartition("/")[2]
        patient = _may_take_long(verb, message)
        reply = self.exchange(key, verb, pack(message), timeout_s, patient=patient, optional=optional)
        with reading(verb):
            return unpack(reply, depth=None)  # it may hold what was stored before there was a limit

    def exchange(
        self,
        key: str,
        verb: str,
        payload: bytes,
        timeout_s: float | None = None,
        *,
        patient: bool = False,
        optional: bool = False,
    ) -> bytes:
        """The same in bytes. Raises what `call` does.

        Args:
            key: Where to.
            verb: The key's last word.
            payload: The message.
            timeout_s: Deadline [s].
            patient: One attempt may take all the time.
            optional: Raise `Unsupported` at once where nobody serves the key, as for a verb that is not offered.
        """
        deadline = self.deadline(timeout_s)
        try:
            return self.transport.query(key, verb, payload, deadline, patient=patient, optional=optional)
        except CrkrError as error:
            with suppress(Invalid):  # details that cannot be read stay as they came
                error.details = plain(error.details)
            raise

    def task_page(self, after: int, timeout_s: float | None) -> tuple[list[Any], int | None]:
        """Entries of the list of tasks past the first `after`, and where to go on (None at the end).

        A server of version 0.1 knows no pages and sends all at once.
        """
        reply = self.call(rpc_key("tasks"), {"after": after, "limit": _PAGE}, timeout_s)
        with reading("tasks"):
            page, following = entries(reply, "tasks"), reply.get("next")
            if following is not None and integer(following, "next") <= after:
                raise Invalid(f"the page after {after} is followed by that after {following}")
            return page, following

    def task_pages(self, deadline: float) -> Iterator[list[Any]]:
        """Every page of that list, by one deadline [s, monotonic clock]."""
        after: int | None = 0
        while after is not None:
            page, after = self.task_page(after, max(deadline - time.monotonic(), 0.001))
            yield page

    def server_id(self, timeout_s: float | None) -> UUID:
        """Which server answers; another id may come with other data, under the same names and versions."""
        reply = self.call(rpc_key("info"), {"limit": 0}, timeout_s)  # without the names of its tasks
        with reading("info"):
            return id_from_wire(reply.get("server_id"), "server_id")


def _may_take_long(verb: str, message: Mapping[str, Any]) -> bool:
    if verb in _PATIENT or message.get("wait") is True:
        return True
    states, trials = message.get("states"), message.get("trials")
    if isinstance(states, np.ndarray):
        return states.ndim > 1 and len(states) > _MANY
    return isinstance(trials, list) and len(trials) > _MANY


def positive(timeout_s: float) -> float:
    """The time [s] as a float; raises `Invalid` for one that is not positive and finite."""
    if not isinstance(timeout_s, int | float) or not 0 < timeout_s < float("inf"):
        raise Invalid(f"timeout_s must be a positive number of seconds; got {timeout_s!r}")
    return float(timeout_s)
