"""Publishes what became of a model, for whoever mirrors or watches it."""

from __future__ import annotations

import logging
from typing import final

import zenoh

from crkr.learner import Model
from crkr.protocol import encoding, pack, pub_key
from crkr.server.tasks import ServedTask

__all__ = ["Notices"]

logger = logging.getLogger(__name__)


@final
class Notices:
    """Sends `model` notices; a subscriber that is slow or away misses them and catches up by query."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._encoding = zenoh.Encoding(encoding("model_notice"))

    def __call__(self, task: ServedTask, before: Model, after: Model) -> None:
        """Says what changed between two models."""
        old, new = set(before.ids), set(after.ids)
        notice = {
            "version": after.version,
            "active": after.active,
            "added": [identity for identity in after.ids if identity not in old],
            "evicted": [identity for identity in before.ids if identity not in new],
        }
        try:
            self._session.put(
                pub_key(task.name, "model"),
                pack(notice),
                encoding=self._encoding,
                congestion_control=zenoh.CongestionControl.DROP,
            )
        except zenoh.ZError as error:  # the session is closing
            logger.debug("model notice was not sent: %s", error)
