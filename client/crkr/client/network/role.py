"""A role that one process at a time has in a task, such as judging it."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from functools import partial
from typing import Final, final
from uuid import uuid4

import zenoh

from crkr.client.lifetimes import Closing, hold
from crkr.client.network.config import brief
from crkr.client.network.presence import end_token, move_token, standing_tokens, take_token, withdraw_token
from crkr.client.network.session import NotConnected, Session
from crkr.protocol import Internal, Unavailable, check_name
from crkr.protocol.keys import claim_role_key, live_role_key

__all__ = ["Role"]

_PAUSE_S: Final = 0.1


@final
class Role(Closing):
    """Held from `take` until it is closed, or its client or process ends; then another process may take it.

    After a server's restart or a broken connection two processes may hold the same role for a while. `is_mine` tells
    all but one of them to close theirs, so work done under a role must be safe to do twice.
    """

    def __init__(self, token: zenoh.LivelinessToken, key: str, session: zenoh.Session, taken: str) -> None:
        self._tokens = [token]
        self._key, self._session, self._taken = key, session, taken
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
        connected = connect(deadline)
        try:
            while (token := take_token(connected, key, partial(claim_role_key, task, role), taken)) is None:
                if standing_tokens(connected, taken) or time.monotonic() > deadline:
                    return None
                owner.pause(_PAUSE_S * random.uniform(0.2, 1.0))  # others claim it at this moment
        except NotConnected as error:
            raise Unavailable(f"{error} at {owner.connection.endpoint}; is the server running?") from error
        except zenoh.ZError as error:
            raise Internal(f"the role {role!r} could not be taken: {brief(error)}") from error
        held = cls(token, key, connected, taken)
        owner.keep(held, connected)
        return held

    def is_mine(self) -> bool:
        """Asks whether this process is to keep the role: False where another holder is, or after `close`."""
        if not self._tokens:
            return False
        try:
            return min(standing_tokens(self._session, self._taken), default=self._key) >= self._key
        except (NotConnected, zenoh.ZError):
            return True  # unknown: keep it

    def move(self, session: zenoh.Session) -> None:
        """As `Declared.move`."""
        self._session = session
        move_token(self, self._tokens, session, self._key)

    def close(self) -> None:
        """Gives the role up; a second call does nothing."""
        end_token(self, self._tokens, withdraw_token, "the role could not be given up")
