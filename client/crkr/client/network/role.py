"""A role that one process at a time has in a task, such as judging it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import final
from uuid import uuid4
from weakref import ref

import zenoh

from crkr.client.lifetimes import Closing, hold
from crkr.client.network.presence import end_token, move_token, standing_tokens, take_token, withdraw_token
from crkr.client.network.session import NotConnected, Session, declare
from crkr.protocol import check_name
from crkr.protocol.keys import claim_role_key, live_role_key

__all__ = ["Role"]


@final
class Role(Closing):
    """Held from `take` until it is closed, or its client or process ends; then another process may take it.

    After a server's restart or a broken connection two processes may hold the same role for a while. `is_mine` tells
    all but one of them to close theirs, so work done under a role must be safe to do twice.
    """

    def __init__(
        self, token: zenoh.LivelinessToken, key: str, session: zenoh.Session, taken: str, owner: Session
    ) -> None:
        self._tokens = [token]
        self._key, self._session, self._taken, self._owner = key, session, taken, ref(owner)
        hold(self, token)

    @classmethod
    def take(
        cls, connect: Callable[[float], zenoh.Session], owner: Session, task: str, role: str, deadline: float
    ) -> Role | None:
        """Takes a free role; None where another process has it.

        Raises:
            Invalid: A key cannot contain the role's name.
            Unavailable: No connection by the deadline.
        """
        key_of = partial(live_role_key, task, check_name(role, "role"))
        key, taken = key_of(str(uuid4())), key_of("*")

        def make(session: zenoh.Session) -> Role | bool | None:
            token = take_token(session, key, partial(claim_role_key, task, role), taken)
            if token is None:
                return False if standing_tokens(session, taken) else None  # None: others claim it at this moment
            held = cls(token, key, session, taken, owner)
            owner.keep(held, session)
            return held

        held = declare(make, f"the role {role!r}", connect, owner, deadline)
        return held if isinstance(held, Role) else None

    def is_mine(self) -> bool:
        """Asks whether this process is to keep the role: False where another holder is, or after `close`."""
        if not self._tokens:
            return False
        owner = self._owner()
        if owner is None:
            return False
        with suppress(zenoh.ZError):
            try:
                with owner.calls:
                    return min(standing_tokens(self._session, self._taken), default=self._key) >= self._key
            except NotConnected:
                owner.suspect()
        return True  # unknown: keep it

    def move(self, session: zenoh.Session) -> object:
        """As `Declared.move`."""
        self._session = session
        return move_token(self, self._tokens, session, self._key)

    def close(self) -> None:
        """Gives the role up; a second call does nothing."""
        end_token(self, self._tokens, withdraw_token, "the role could not be given up")
