"""A part that one process at a time plays in a task, such as judging it."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from functools import partial
from typing import Final, final
from uuid import uuid4

import zenoh

from crkr.client.lifetimes import Closing, hold, is_forked, release
from crkr.client.network.config import brief
from crkr.client.network.presence import standing_tokens, take_token, withdraw_token
from crkr.client.network.session import NotConnected, Session
from crkr.protocol import Internal, Unavailable, check_name
from crkr.protocol.keys import claim_role_key, live_role_key

__all__ = ["Role"]

_PAUSE_S: Final = 0.1


@final
class Role(Closing):
    """Held from `take` until it is closed, or its client or process ends; then it is free for others.

    Two may hold one after a server's restart or a broken connection, when a holder's token was away for a moment: all
    but one learn that from `is_mine` and close theirs, and what is done under a role must bear being done twice.
    """

    def __init__(self, token: zenoh.LivelinessToken, key: str, session: zenoh.Session, taken: str) -> None:
        self._tokens = [token]
        self._key, self._session, self._taken = key, session, taken
        hold(self, token)

    @classmethod
    def take(
        cls, connect: Callable[[float], zenoh.Session], owner: Session, task: str, role: str, deadline: float
    ) -> Role | None:
        """Takes a role that is free; None where another process has it.

        Raises:
            Invalid: The role's name cannot stand in a key.
            Unavailable: No connection by the deadline.
        """
        key_of = partial(live_role_key, task, check_name(role, "role"))
        key, taken = key_of(str(uuid4())), key_of("*")
        connected = connect(deadline)
        try:
            while (token := take_token(connected, key, partial(claim_role_key, task, role), taken)) is None:
                if standing_tokens(connected, taken) or time.monotonic() > deadline:
                    return None
                owner.pause(_PAUSE_S * random.uniform(0.2, 1.0))  # others want it at this moment
        except NotConnected as error:
            raise Unavailable(f"{error} at {owner.connection.endpoint}; is the server running?") from error
        except zenoh.ZError as error:
            raise Internal(f"the role {role!r} could not be taken: {brief(error)}") from error
        return cls(token, key, connected, taken)

    def is_mine(self) -> bool:
        """Asks: False where another holds it too who is to keep it, or where it was closed."""
        if not self._tokens:
            return False
        try:
            return min(standing_tokens(self._session, self._taken), default=self._key) >= self._key
        except (NotConnected, zenoh.ZError):
            return True  # nobody tells otherwise

    def close(self) -> None:
        """Lets go of the role; a second call does nothing."""
        if is_forked():
            return
        try:
            token = self._tokens.pop()
        except IndexError:
            return
        release(self)
        try:
            withdraw_token(token)
        except zenoh.ZError as error:
            if "closed" not in str(error).lower():  # with its session, a token is gone already
                raise Internal(f"the role could not be let go: {brief(error)}") from error
