"""Which answers are the server's: without access control any client may declare a queryable on the server's keys.

Zenoh names the session that replied. The server's session is the router that a client is connected to, and a router
accepts no second session with its id; so that router's answers are the server's, and all others are ignored, but those
of the servers with which it says that it shares its tasks. Behind another router, the session that answers first is
taken for the server until a question to all ends without its answer.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Final, final

import zenoh

from crkr.protocol import Invalid, encoding, pack, rpc_key, unpack

__all__ = ["EVERYONE", "NotTheServer", "Trust"]

_logger = logging.getLogger(__name__)
_ASK_S: Final = 0.5
_ASK_AGAIN_S: Final = 0.25
_MOST_OTHERS: Final = 16  # sessions whose replies are kept until the question ends
EVERYONE: Final = zenoh.QueryTarget.ALL  # or a queryable declared complete would be asked instead of the server
_TIMEOUT: Final = b"Timeout"  # Zenoh's own error, when the time of a question is over


class NotTheServer(Exception):
    """A question was answered, but not by the server."""


@final
class Trust:
    """What a client knows of the server's session; threads may share it."""

    def __init__(self) -> None:
        self._server: zenoh.ZenohId | None = None
        self._is_router = False
        self._sharing: frozenset[str] = frozenset()  # Zenoh ids of the servers that share its tasks
        self._told_at = self._asked_at = -_ASK_AGAIN_S  # when the router said who shares, and was asked [s, monotonic]
        self._warned = False

    def pick(
        self, session: zenoh.Session, replies: zenoh.handlers.Handler[zenoh.Reply], others: dict[str, zenoh.Reply]
    ) -> zenoh.Reply:
        """Returns the server's reply, or Zenoh's own error, among the replies to one question.

        Args:
            session: The client's.
            replies: To the question.
            others: Filled with the replies of other sessions, by session.

        Raises:
            zenoh.ZError: The question ended without an answer.
            NotTheServer: It ended with answers of other clients only.
        """
        while True:
            try:
                reply = replies.recv()
            except zenoh.ZError:
                if not others:
                    raise
                found = self.sharing_server(session, others)
                if found is not None:
                    return found
                stranger = next(iter(others.values()))
                if not self._is_router:
                    return self._adopt(stranger)
                raise NotTheServer(
                    f"the answer was of another client, not of the server: Zenoh id {_zid(stranger)}"
                ) from None
            if self.is_server(session, reply):
                return reply
            if _is_timeout(reply):
                return self.sharing_server(session, others) or reply
            if len(others) < _MOST_OTHERS:
                others.setdefault(_zid(reply), reply)

    def is_server(self, session: zenoh.Session, reply: zenoh.Reply) -> bool:
        """Whether a reply is known to be the server's."""
        replier = reply.replier_id
        if replier is None:
            return False
        if replier.zid == self._server:
            return True
        if replier.zid in session.info.routers_zid():  # the first answer, or the first after a restart
            self._server, self._is_router = replier.zid, True
            return True
        return str(replier.zid) in self._sharing

    def sharing_server(self, session: zenoh.Session, others: Mapping[str, zenoh.Reply]) -> zenoh.Reply | None:
        """The reply of a server that shares this one's tasks; the router is asked which do, now and then.

        It is asked once the question has ended: Zenoh receives nothing more while a channel of replies is full.
        """
        if not self._is_router or not others:
            return None
        self._knows_who_shares(session)
        return next((reply for reply in others.values() if self.is_server(session, reply)), None)

    def tell_of_strangers(self, session: zenoh.Session, others: Mapping[str, zenoh.Reply]) -> None:
        """Warns once of answers by a session that is no server. Call it when the question's replies are dropped."""
        if self._warned or not self._strangers(others):
            return
        with suppress(zenoh.ZError):  # the session was closed
            if self._is_router and not self._knows_who_shares(session):
                return
            stranger = next(iter(self._strangers(others)), None)
            if stranger is not None:
                self._warned = True
                _logger.warning(
                    "ignored an answer that is not the server's, but another client's: Zenoh id %s", stranger
                )

    def _strangers(self, others: Mapping[str, zenoh.Reply]) -> list[str]:
        return [zid for zid in others if zid not in self._sharing and zid != str(self._server)]

    def _knows_who_shares(self, session: zenoh.Session) -> bool:
        """Whether the router said just now which servers share its tasks; asks it at most every quarter of a second."""
        now = time.monotonic()
        if now - self._told_at < _ASK_AGAIN_S:
            return True
        if now - self._asked_at < _ASK_AGAIN_S:
            return False
        self._asked_at = now
        routers = set(session.info.routers_zid())
        replies = session.get(
            rpc_key("info"),
            zenoh.handlers.FifoChannel(4),
            payload=pack({"limit": 0}),
            encoding=encoding("info"),
            consolidation=zenoh.ConsolidationMode.NONE,
            target=EVERYONE,
            timeout=_ASK_S,
        )
        for reply in replies:
            if reply.ok is not None and reply.replier_id is not None and reply.replier_id.zid in routers:
                with suppress(Invalid):
                    told = unpack(reply.ok.payload.to_bytes()).get("servers", ())
                    self._sharing = frozenset(one for one in told if isinstance(one, str))
                    self._told_at = time.monotonic()
                    return True
                break
        return False

    def _adopt(self, reply: zenoh.Reply) -> zenoh.Reply:
        """Takes another session, behind a router, for the server."""
        if self._server is not None:
            _logger.warning("another server answers, Zenoh id %s: the one before is gone", _zid(reply))
        self._server = None if reply.replier_id is None else reply.replier_id.zid
        return reply


def _is_timeout(reply: zenoh.Reply) -> bool:
    return reply.replier_id is None and reply.err is not None and reply.err.payload.to_bytes() == _TIMEOUT


def _zid(reply: zenoh.Reply) -> str:
    return "unknown" if reply.replier_id is None else str(reply.replier_id.zid)
