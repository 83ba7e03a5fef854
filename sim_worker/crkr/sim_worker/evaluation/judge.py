"""Of the launchers that train one task, one has its epochs judged; the others follow, and take over when it ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, final

from crkr.client import Client, Role, Task
from crkr.protocol import CrkrError
from crkr.sim_worker.evaluation.epochs import EpochClock, judged_epochs

__all__ = ["JudgeSeat"]

ROLE: Final = "judge"
EVERY_S: Final = 1.0


@final
class JudgeSeat:
    """This launcher's part in judging a task.

    Args:
        client: The launcher's.
        task: What is trained.
        say: Prints a line for people.
    """

    def __init__(self, client: Client, task: Task, say: Callable[[str], None]) -> None:
        self._client = client
        self._task = task
        self._say = say
        self._role: Role | None = None
        self._clock: EpochClock | None = None
        self._next_look = 0.0
        self._follows = False

    @property
    def clock(self) -> EpochClock | None:
        """Names the epochs that this launcher's workers are to judge; None while another launcher's do."""
        return self._clock

    def look(self, trained: int) -> None:
        """Takes the seat if it is free, now and then; `trained` are the training trials stored."""
        if time.monotonic() < self._next_look:
            return
        self._next_look = time.monotonic() + EVERY_S
        if self._role is not None and not self._role.is_mine():
            self.close()
        try:
            if self._role is None:
                self._role = self._client.take_role(self._task.name, ROLE, timeout_s=EVERY_S)
            if self._role is not None and self._clock is None:
                self._clock = EpochClock(trained, judged_epochs(self._task))
        except CrkrError:
            return  # the workers, who are more patient, tell when the server is away
        self._tell()

    def close(self) -> None:
        """Leaves the seat to others."""
        if self._role is not None:
            self._role.close()
        self._role = self._clock = None

    def _tell(self) -> None:
        if self._follows != (self._clock is None):
            self._follows = self._clock is None
            self._say(
                "another launcher has the epochs judged" if self._follows else "this launcher has the epochs judged now"
            )
