"""Whose answers are the server's: any client may declare a queryable on the server's keys where nothing forbids it.

Zenoh names the session that replied. The server's own session is the router that a client is connected to, and a router
connects no second session with its id; so an answer of that router is the server's, and all others are ignored. Where
another router stands in between, the session that answered first is taken for the server until it is gone: until a
question to all comes to its end without an answer of it.
"""

from __future__ import annotations

import logging
import math
import operator
from collections.abc import Sequence
from typing import Final, final

import numpy as np
import zenoh

from crkr.protocol import Array, Invalid, Prediction, Receipt, TaskSpec

__all__ = ["EVERYONE", "Goals", "NotTheServer", "Trust", "check_receipt"]

_logger = logging.getLogger(__name__)
EVERYONE: Final = zenoh.QueryTarget.ALL  # or one who claims to answer for all would be asked in the server's place
_TIMEOUT: Final = b"Timeout"  # Zenoh's own error, when the time of a question is over


class NotTheServer(Exception):
    """A question was answered, but not by the server."""


@final
class Trust:
    """What a client knows of the server's session; safe to use from many threads.

    Attributes:
        strangers: Answers that were ignored, as they were not the server's.
    """

    def __init__(self) -> None:
        self._server: zenoh.ZenohId | None = None
        self._is_router = False
        self.strangers = 0

    def pick(self, session: zenoh.Session, replies: zenoh.handlers.Handler[zenoh.Reply]) -> zenoh.Reply:
        """The server's reply, or Zenoh's own error, among those to one question.

        Raises:
            zenoh.ZError: The question has ended without an answer.
            NotTheServer: It has ended with answers of others.
        """
        stranger: zenoh.Reply | None = None
        while True:
            try:
                reply = replies.recv()
            except zenoh.ZError:
                if stranger is None:
                    raise
                if not self._is_router:
                    return self._adopt(stranger)
                raise NotTheServer(f"the answer was of another client, not of the server: {_name(stranger)}") from None
            if self.is_server(session, reply) or _is_timeout(reply):
                return reply
            self._note(reply)
            stranger = stranger or reply

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
        return False

    def _adopt(self, reply: zenoh.Reply) -> zenoh.Reply:
        """Takes another for the server, which a router stands before."""
        if self._server is not None:
            _logger.warning("another server answers, %s: the one before is gone", _name(reply))
        self._server = None if reply.replier_id is None else reply.replier_id.zid
        return reply

    def _note(self, reply: zenoh.Reply) -> None:
        self.strangers += 1
        level = logging.WARNING if self.strangers == 1 else logging.DEBUG
        _logger.log(level, "ignored an answer that is not the server's, but another client's: %s", _name(reply))


def _is_timeout(reply: zenoh.Reply) -> bool:
    return reply.replier_id is None and reply.err is not None and reply.err.payload.to_bytes() == _TIMEOUT


def _name(reply: zenoh.Reply) -> str:
    return "without a Zenoh id" if reply.replier_id is None else f"Zenoh id {reply.replier_id.zid}"


@final
class Goals:
    """What goals a task can have, whoever proposes them.

    Args:
        spec: The task's specification.
    """

    def __init__(self, spec: TaskSpec) -> None:
        self._spec = spec
        self._low, self._high = spec.bounds
        self._lows, self._highs = self._low.tolist(), self._high.tolist()

    def check(self, answer: Prediction, ids: Sequence[bytes]) -> Prediction:
        """The answer, if a robot may try it.

        Args:
            answer: As it was read.
            ids: Those that were asked for, 16 bytes each.

        Raises:
            Invalid: Goals outside the bounds, of another shape or not finite; other ids.
        """
        shape = (*answer.states.shape[:-1], len(self._lows))
        if not answer.goals.shape == answer.means.shape == answer.sigmas.shape == shape:
            raise Invalid(f"goals, means and sigmas must have the shape {shape}")
        if not (self._has_one(answer) if len(shape) == 1 else self._has_all(answer)):
            raise Invalid(self._complaint(answer.goals))
        if [one.bytes for one in answer.trial_ids] != ids:
            raise Invalid("it is about other trials than those that were asked about")
        return answer

    def _has_one(self, answer: Prediction) -> bool:
        """For one state, without numpy's price for few numbers."""
        goals = answer.goals.tolist()
        if not (all(map(operator.le, self._lows, goals)) and all(map(operator.le, goals, self._highs))):
            return False
        total = sum(answer.means.tolist()) + sum(answer.sigmas.tolist())
        return math.isfinite(total) or self._has_all(answer)  # a sum of finite numbers may overflow

    def _has_all(self, answer: Prediction) -> bool:
        within = ((answer.goals >= self._low) & (answer.goals <= self._high)).all()
        return bool(within and np.isfinite(answer.means).all() and np.isfinite(answer.sigmas).all())

    def _complaint(self, goals: Array) -> str:
        wrong = np.argwhere(~((goals >= self._low) & (goals <= self._high)))
        if not len(wrong):
            return "its means and sigmas must be finite"
        outside = wrong[0]
        axis, given = self._spec.goal[outside[-1]], goals[tuple(outside)]
        return f"goal {axis.name!r} must be in [{axis.low}, {axis.high}] {axis.unit}; got {given}: not to be tried"


def check_receipt(receipt: Receipt, count: int) -> Receipt:
    """The receipt of `count` trials; raises `Invalid` where it is one of others."""
    if receipt.accepted + receipt.duplicates != count or len(receipt.seqs) != count:
        raise Invalid(f"it acknowledges {receipt.accepted + receipt.duplicates} trials of {count}")
    return receipt
