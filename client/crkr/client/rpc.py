"""Calls: send a map, receive a map, by a deadline."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any, Final, final
from uuid import UUID

import numpy as np

from crkr.client.checks import answer_to, plain, positive
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

__all__ = ["Rpc"]

# Verbs that may take longer than one ordinary attempt; a repeated attempt would only double the work.
_PATIENT: Final = frozenset({*ADMIN_VERBS, "create_task", "explain", "model", "samples"})
_MANY: Final = 16  # states or trials in a message; larger messages may take long too
_PAGE: Final = 1000  # tasks


@final
class Rpc:
    """Calls with a default deadline over a transport."""

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
        with answer_to(verb):
            return unpack(reply, depth=None)  # data of earlier versions may be nested deeper

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
        """As `call`, with packed messages.

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
            with suppress(Invalid):  # details that cannot be decoded stay as they are
                error.details = plain(error.details)
            raise

    def task_page(self, after: int, timeout_s: float | None) -> tuple[list[Any], int | None]:
        """One page of the list of tasks past the first `after`, and the next `after` (None at the end).

        A server of version 0.1 sends all tasks as one page.
        """
        reply = self.call(rpc_key("tasks"), {"after": after, "limit": _PAGE}, timeout_s)
        with answer_to("tasks"):
            page, following = entries(reply, "tasks"), reply.get("next")
            if following is not None and integer(following, "next") <= after:
                raise Invalid(f"the page after {after} is followed by that after {following}")
            return page, following

    def task_pages(self, deadline: float) -> Iterator[list[Any]]:
        """Every page of the list, by one deadline [s, monotonic clock]."""
        after: int | None = 0
        while after is not None:
            page, after = self.task_page(after, max(deadline - time.monotonic(), 0.001))
            yield page

    def server_id(self, timeout_s: float | None) -> UUID:
        """The id of the server that answers. A server with another id may have other data under the same task names."""
        reply = self.call(rpc_key("info"), {"limit": 0}, timeout_s)  # without task names
        with answer_to("info"):
            return id_from_wire(reply.get("server_id"), "server_id")


def _may_take_long(verb: str, message: Mapping[str, Any]) -> bool:
    if verb in _PATIENT or message.get("wait") is True:
        return True
    states, trials = message.get("states"), message.get("trials")
    if isinstance(states, np.ndarray):
        return states.ndim > 1 and len(states) > _MANY
    return isinstance(trials, list) and len(trials) > _MANY
