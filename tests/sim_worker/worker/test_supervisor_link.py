"""Orders as they come over a real pipe."""

from collections.abc import Iterator
from multiprocessing import Pipe
from typing import Any

import pytest

from crkr.sim_worker.supervisor.child_process import MessagePipe
from crkr.sim_worker.worker.supervisor_link import Stopped, SupervisorLink

Ends = tuple[SupervisorLink, MessagePipe]


@pytest.fixture
def both_ends() -> Iterator[Ends]:
    """A worker's link, and its supervisor's end of the pipe."""
    ours, theirs = Pipe()
    with ours, theirs:
        yield SupervisorLink(MessagePipe(ours), 5.0), MessagePipe(theirs)


def test_epochs_are_judged_before_trials_and_in_the_order_they_ended(
    both_ends: Ends,
) -> None:
    link, supervisor = both_ends
    kinds = ["go", "judge", "go", "judge"]
    sent: list[dict[str, Any]] = [{"order": order, "number": number} for number, order in enumerate(kinds)]
    for message in sent:
        supervisor.send(message)
    assert [link.next_order() for _ in sent] == [sent[1], sent[3], sent[0], sent[2]]
    assert not link.has_order()


def test_stop_overtakes_what_waits(both_ends: Ends) -> None:
    link, supervisor = both_ends
    for order in ("go", "judge", "stop"):
        supervisor.send({"order": order})
    with pytest.raises(Stopped):
        link.next_order()
