"""The interface for programs that learn by trying: ask for a goal, report its cost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol
from uuid import UUID

from crkr.protocol import Prediction, Receipt, TrialFields
from crkr.protocol.earlier_python import Unpack

__all__ = ["AsyncPolicy", "Policy"]


class Policy(Protocol):
    """A policy: `crkr.learner.Learner` in process, `Task` at a server, or `Mirror`, its local copy."""

    def predict(self, states: object, explore: bool = False, *, trial_ids: Sequence[UUID] | None = None) -> Prediction:
        """Goals for one state (d,) or a batch (b, d).

        Args:
            states: The situation, or b of them.
            explore: Draw goals to try rather than the best known.
            trial_ids: Ids of the trials to come, which fix the draw; made where absent.

        Raises:
            Invalid: States of another shape, or not finite.
            NoSamples: Nothing was learned yet.
            NovelState: The task refuses states this far from its samples.
        """

    def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        """Reports one trial or a batch, all or none; a repeated id is stored once.

        Args:
            answer: The prediction that was tried; or give `state` and `goal`.
            trial: What was tried and its result.

        Raises:
            Invalid: A value of the wrong shape or out of range.
            Conflict: An id is known with other content.
        """


class AsyncPolicy(Protocol):
    """The same, awaited: `AsyncTask` is one."""

    async def predict(
        self, states: object, explore: bool = False, *, trial_ids: Sequence[UUID] | None = None
    ) -> Prediction:
        """As `Policy.predict`."""

    async def report(self, answer: Prediction | None = None, **trial: Unpack[TrialFields]) -> Receipt:
        """As `Policy.report`."""
