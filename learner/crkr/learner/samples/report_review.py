"""What a report would change, found out without changing anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final
from uuid import UUID

from crkr.learner.samples.store import SampleStore
from crkr.protocol import Conflict, Trial

__all__ = ["Review", "review"]


@final
@dataclass(frozen=True, slots=True)
class Review:
    """Which trials of a report are new.

    Attributes:
        fresh: Positions in the report of the trials to store, in order.
        known: For each trial the log position it was stored under, or None.
        same_as: For each trial the position in the report of the first one with its id; usually its own.
    """

    fresh: tuple[int, ...]
    known: tuple[int | None, ...]
    same_as: tuple[int, ...]

    def seqs(self, first: int) -> tuple[int, ...]:
        """Log positions in the order of the report, if the fresh trials are stored from `first` on."""
        given = {position: first + count for count, position in enumerate(self.fresh)}
        return tuple(
            known if known is not None else given[same] for known, same in zip(self.known, self.same_as, strict=True)
        )


def review(store: SampleStore, trials: Sequence[Trial]) -> Review:
    """Compares a report with what is stored, and with itself.

    Raises:
        Conflict: An id comes with other content than before.
    """
    first: dict[UUID, int] = {}
    fresh, known, same_as = [], [], []
    for position, trial in enumerate(trials):
        row = store.original(trial)
        earlier = first.setdefault(trial.id, position)
        if earlier != position and trials[earlier].digest() != trial.digest():
            raise Conflict(
                f"id {trial.id} comes twice in one report with different content; use a new id for a new trial",
                details={"id": str(trial.id)},
            )
        if row is None and earlier == position:
            fresh.append(position)
        known.append(None if row is None else int(store.seqs[row]))
        same_as.append(earlier)
    return Review(tuple(fresh), tuple(known), tuple(same_as))
