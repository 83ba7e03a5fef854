"""A worker's presence: a Zenoh liveliness token, which Zenoh withdraws when the worker's process ends.

A worker claims its id by a second token before it declares the first. Of two workers that claim an id at the same time
at least one sees the other's claim and gives up. A worker that leaves declares a third token while it withdraws the
first, so that the server does not count it as lost.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Final, final
from uuid import uuid4

import zenoh

from crkr.client.lifetimes import Closing, hold, is_forked, release
from crkr.client.network.config import brief
from crkr.client.network.session import NotConnected, Session, declare
from crkr.protocol import Conflict, Internal, Invalid, live_worker_key
from crkr.protocol.keys import claim_worker_key, left_worker_key

__all__ = ["Presence", "end_token", "move_token", "standing_tokens", "take_token", "withdraw_token"]

_WORKER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,126}")


@final
class Presence(Closing):
    """Holds the token from `announce` to `close`, or until the client is closed.

    It is declared again after a reconnect.
    """

    def __init__(self, task: str, worker_id: str, token: zenoh.LivelinessToken, session: zenoh.Session) -> None:
        self.worker_id: Final = worker_id
        self._tokens = [token]
        self._session, self._task = session, task
        hold(self, token)

    @classmethod
    def announce(
        cls, connect: Callable[[float], zenoh.Session], owner: Session, task: str, worker_id: str, deadline: float
    ) -> Presence:
        """Declares the token.

        Args:
            connect: Gives the open session by a deadline.
            owner: Closes the presence before it closes that session.
            task: The task's name.
            worker_id: The worker's id.
            deadline: When to give up [s, monotonic clock].

        Raises:
            Invalid: A key cannot contain the worker's id.
            Conflict: Another process holds that id; a killed one's is free again within two seconds.
            Unavailable: No connection by the deadline.
        """
        if not isinstance(worker_id, str) or _WORKER.fullmatch(worker_id) is None:
            raise Invalid(f"a worker id is 1 to 127 of A-Z, a-z, 0-9 and ._:- ; got {worker_id!r:.200}")
        key, claim = live_worker_key(task, worker_id), partial(claim_worker_key, task, worker_id)

        def make(session: zenoh.Session) -> Presence | None:
            if (token := take_token(session, key, claim)) is None:
                return None
            presence = cls(task, worker_id, token, session)
            owner.keep(presence, session)
            return presence

        presence = declare(make, f"the token of worker {worker_id!r}", connect, owner, deadline)
        if presence is None:
            raise Conflict(f"worker id {worker_id!r} is in use on task {task!r}: give each worker its own")
        owner.close_before(presence)
        return presence

    def close(self) -> None:
        """Announces that the worker leaves and withdraws its token; a second call does nothing."""
        end_token(self, self._tokens, self._leave, "the token could not be withdrawn")

    def move(self, session: zenoh.Session) -> object:
        """As `Declared.move`."""
        self._session = session
        return move_token(self, self._tokens, session, live_worker_key(self._task, self.worker_id))

    def _leave(self, token: zenoh.LivelinessToken) -> None:
        left = self._session.liveliness().declare_token(left_worker_key(self._task, self.worker_id))
        withdraw_token(token)
        withdraw_token(left)


def take_token(
    session: zenoh.Session, key: str, claim_key: Callable[[str], str], taken: str | None = None
) -> zenoh.LivelinessToken | None:
    """Declares a token that only one process may hold; None where another process holds it or claims it too.

    A holder claims the token first and withdraws the claim after declaring the token, so one of the two always shows.

    Args:
        session: Whose token it will be.
        key: Of the token.
        claim_key: Key of a claim to it, by the claim's name.
        taken: Key expression of the tokens that exclude this one; `key` unless given.

    Raises:
        NotConnected: The router did not list the tokens.
    """
    claim, taken = claim_key(str(uuid4())), taken or key
    if standing_tokens(session, taken):
        return None
    claimed = session.liveliness().declare_token(claim)
    try:
        if standing_tokens(session, claim_key("*")) - {claim} or standing_tokens(session, taken):
            return None
        return session.liveliness().declare_token(key)
    finally:
        withdraw_token(claimed)


def standing_tokens(session: zenoh.Session, key: str) -> set[str]:
    """Keys of the declared tokens; raises `NotConnected` if the router does not list them."""
    replies = list(session.liveliness().get(key, zenoh.handlers.FifoChannel(16), timeout=0.5))
    if any(reply.ok is None for reply in replies) or not session.info.routers_zid():
        raise NotConnected("the router did not say who is there")
    return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}


def move_token(owner: object, tokens: list[zenoh.LivelinessToken], session: zenoh.Session, key: str) -> object:
    """Declares in another session the token that `owner` holds, unless it was withdrawn; returns the former one."""
    token = session.liveliness().declare_token(key)
    try:
        former, tokens[0] = tokens[0], token
    except IndexError:
        withdraw_token(token)
        return None
    hold(owner, token)
    return former


def withdraw_token(token: zenoh.LivelinessToken) -> None:
    """Withdraws a token."""
    token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type


def end_token(
    owner: object,
    tokens: list[zenoh.LivelinessToken],
    withdraw: Callable[[zenoh.LivelinessToken], None],
    complaint: str,
) -> None:
    """Withdraws the token that `owner` holds; does nothing where it was withdrawn before, or in a forked child.

    Raises:
        Internal: Zenoh refuses.
    """
    if is_forked():
        return
    try:
        token = tokens.pop()  # of two threads, one gets it
    except IndexError:
        return
    release(owner)
    try:
        withdraw(token)
    except zenoh.ZError as error:
        if "closed" not in str(error).lower():  # the token ended with its session
            raise Internal(f"{complaint}: {brief(error)}") from error
