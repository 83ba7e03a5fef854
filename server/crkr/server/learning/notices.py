"""Publish each change of a model, for mirrors and dashboards."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, final
from uuid import UUID

import zenoh

from crkr.learner import Model
from crkr.protocol import encoding, pack, pub_key
from crkr.server.learning.served_task import ServedTask
from crkr.server.thread_faults import FAULTS

__all__ = ["Notices"]

logger = logging.getLogger(__name__)


@final
class Notices:
    """Sends `model` notices. Subscribers that miss one catch up by query."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._encoding = zenoh.Encoding(encoding("model_notice"))

    def move(self, session: zenoh.Session) -> None:
        """Publish through another session from now on."""
        self._session = session

    def __call__(self, task: ServedTask, before: Model, after: Model) -> None:
        """Publish the ids that entered and left the active set."""
        added, evicted = ([], []) if after.ids is before.ids else _exchanged(before.ids, after.ids)
        notice: dict[str, Any] = {"version": after.version, "active": after.active, "added": added, "evicted": evicted}
        if task.drift is not None:
            notice["drift"] = {"restarts": task.drift.restarts, "score": task.drift.score}
        try:
            self._session.put(
                pub_key(task.name, "model"),
                pack(notice),
                encoding=self._encoding,
                congestion_control=zenoh.CongestionControl.DROP,
            )
        except zenoh.ZError as error:  # the session is closing
            logger.debug("model notice was not sent: %s", error)
        except BaseException as error:  # a panic in Zenoh must not stop learning
            FAULTS.note(error)


def _exchanged(before: Sequence[UUID], after: Sequence[UUID]) -> tuple[list[UUID], list[UUID]]:
    """Ids added and evicted, in log order."""
    old, new = set(before), set(after)
    return [one for one in after if one not in old], [one for one in before if one not in new]
