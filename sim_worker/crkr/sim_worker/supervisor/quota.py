"""Limits the training trials that may still start, so that the task ends with exactly its total."""

from __future__ import annotations

from typing import final

__all__ = ["Quota"]


@final
class Quota:
    """Counts tickets for training trials; a ticket is one trial that may be started.

    One supervisor meets the total exactly, also if others report trials before its last tickets are granted; later
    reports exceed it. Each of several supervisors takes a quarter of the remaining trials and asks again, so that the
    total is exceeded by at most the others' running trials.

    Args:
        total: Total training trials of the task; None: no limit.
        stored: Current training trials of the task.
    """

    def __init__(self, total: int | None, stored: int) -> None:
        self._total = total
        self._base = stored
        self._granted = 0
        self._done = 0
        self._others = 0  # at least
        self._others_at_most = 0  # at the last look
        self._seen = stored
        self._share = 0  # tickets that may still be granted before the next look, where others train too

    @property
    def trained(self) -> int:
        """Training trials known to be stored."""
        return max(self._seen, self._base + self._done + self._others)

    @property
    def left(self) -> int | None:
        """Tickets that can be granted now; None is no limit."""
        if self._total is None:
            return None
        return max(0, self._total - self._base - self._granted - self._others_at_most)

    @property
    def shared(self) -> bool:
        """Whether other supervisors train towards the same total."""
        return self._total is not None and self._others > 0

    def grant(self, wanted: int) -> int:
        """Takes up to `wanted` tickets; returns how many."""
        granted = wanted if self.left is None else min(wanted, self.left)
        if self.shared:
            granted = min(granted, self._share)
            self._share -= granted
        self._granted += granted
        return granted

    def done(self) -> None:
        """Counts a ticket that became a stored trial."""
        self._done += 1

    def observe(self, stored: int) -> None:
        """Updates the number of training trials of the task; those beyond our tickets are others'.

        Stored trials of ours whose workers have not reported them yet count as others' until the next call: a ticket
        granted late is harmless, one too many cannot be taken back.
        """
        self._others = max(self._others, stored - self._base - self._granted)
        self._others_at_most = stored - self._base - self._done
        self._seen = max(self._seen, stored)
        self._share = max(1, (self.left or 0) // 4)

    def settle(self, stored: int) -> None:
        """Starts again from the true count without open tickets, so that those of lost workers return."""
        self._base, self._granted, self._done, self._others, self._others_at_most = stored, 0, 0, 0, 0
        self._seen = max(self._seen, stored)
