"""A worker's sign of life: a Zenoh liveliness token that vanishes with its process.

Two tokens more stand beside it for a moment. Whoever wants an id first claims it: of two who do so at once at least one
sees the other's claim, and whoever sees one steps back. Whoever leaves says so by a token while it withdraws its own,
so that it is not taken for lost.
"""

from __future__ import annotations

import random
import re
import time
from functools import partial
from types import TracebackType
from typing import Final, final

import zenoh

from crkr.client.lifetimes import hold, is_forked, release
from crkr.client.network.config import brief
from crkr.client.network.liveliness_tokens import take, withdraw
from crkr.client.network.session import NotConnected
from crkr.client.network.zenoh_transport import Transport
from crkr.protocol import Conflict, CrkrError, Internal, Invalid, Unavailable, live_worker_key
from crkr.protocol.keys import claim_worker_key, left_worker_key

__all__ = ["Presence"]

_WORKER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,126}")
_PAUSE_S: Final = 0.1


@final
class Presence:
    """Holds the token from `announce` to the end of the `with` block or of the client, whichever comes first.

    It is declared again by itself after a reconnect.

    Attributes:
        worker_id: Who is there.
    """

    def __init__(self, worker_id: str, token: zenoh.LivelinessToken, session: zenoh.Session, left_key: str) -> None:
        self.worker_id: Final = worker_id
        self._tokens = [token]
        self._session, self._left_key = session, left_key
        hold(self, token)

    @classmethod
    def announce(cls, transport: Transport, task: str, worker_id: str, deadline: float) -> Presence:
        """Declares the token.

        Raises:
            Invalid: The worker's id cannot stand in a key.
            Conflict: Another process holds that id; a killed one's is free again within two seconds.
            Unavailable: No connection by the deadline.
        """
        if not isinstance(worker_id, str) or _WORKER.fullmatch(worker_id) is None:
            raise Invalid(f"a worker id is 1 to 127 of A-Z, a-z, 0-9 and ._:- ; got {worker_id!r:.200}")
        session = transport.connect(deadline)
        try:
            while isinstance(token := _take(session, task, worker_id, transport.endpoint), CrkrError):
                if time.monotonic() > deadline:
                    raise token
                transport.session.pause(_PAUSE_S * random.uniform(0.2, 1.0))
            presence = cls(worker_id, token, session, left_worker_key(task, worker_id))
        except zenoh.ZError as error:
            raise Internal(f"the token of worker {worker_id!r} could not be declared: {brief(error)}") from error
        transport.session.see_off(presence)
        return presence

    def close(self) -> None:
        """Says that the worker leaves and withdraws its token; a second call does nothing."""
        if is_forked():
            return
        try:
            token = self._tokens.pop()  # one of two threads gets it
        except IndexError:
            return
        release(self)
        try:
            left = self._session.liveliness().declare_token(self._left_key)
            withdraw(token)
            withdraw(left)
        except zenoh.ZError as error:
            if "closed" not in str(error).lower():  # with its session, a token is gone already
                raise Internal(f"the token could not be withdrawn: {brief(error)}") from error

    def __enter__(self) -> Presence:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _take(session: zenoh.Session, task: str, worker_id: str, endpoint: str) -> zenoh.LivelinessToken | CrkrError:
    """The token of a worker's id, or why there is none now."""
    try:
        token = take(session, live_worker_key(task, worker_id), partial(claim_worker_key, task, worker_id))
    except NotConnected as error:
        return Unavailable(f"{error} at {endpoint}; is the server running?")
    return token or Conflict(f"worker id {worker_id!r} is in use on task {task!r}: give each worker its own")
