"""A worker's sign of life: a Zenoh liveliness token that vanishes with its process."""

from __future__ import annotations

import re
import time
from types import TracebackType
from typing import Final, final

import zenoh

from crkr.client.config import brief
from crkr.client.forks import hold, is_forked, release
from crkr.client.transport import Transport
from crkr.protocol import Conflict, Internal, Invalid, live_worker_key

__all__ = ["Presence"]

_WORKER: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:-]{0,126}")
_PAUSE_S: Final = 0.1


@final
class Presence:
    """Holds the token from `announce` to the end of the `with` block; declared again by itself after a reconnect.

    Attributes:
        worker_id: Who is there.
    """

    def __init__(self, worker_id: str, token: zenoh.LivelinessToken) -> None:
        self.worker_id: Final = worker_id
        self._token: zenoh.LivelinessToken | None = token
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
        key = live_worker_key(task, worker_id)
        session = transport.connect(deadline)
        try:
            while _is_alive(session, key):
                if time.monotonic() > deadline:
                    raise Conflict(f"worker id {worker_id!r} is in use on task {task!r}: give each worker its own")
                transport.session.pause(_PAUSE_S)
            return cls(worker_id, session.liveliness().declare_token(key))
        except zenoh.ZError as error:
            raise Internal(f"the token of worker {worker_id!r} could not be declared: {brief(error)}") from error

    def close(self) -> None:
        """Withdraws the token; a second call does nothing."""
        if is_forked():
            return
        token, self._token = self._token, None
        release(self)
        if token is not None:
            try:
                token.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub gives it no return type
            except zenoh.ZError as error:
                if "closed" not in str(error).lower():  # with its session, a token is gone already
                    raise Internal(f"the token could not be withdrawn: {brief(error)}") from error

    def __enter__(self) -> Presence:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _is_alive(session: zenoh.Session, key: str) -> bool:
    replies = session.liveliness().get(key, zenoh.handlers.FifoChannel(16), timeout=0.5)
    return any(reply.ok is not None for reply in replies)
