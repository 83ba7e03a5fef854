"""Orders as they come over a real line."""

from collections.abc import Iterator
from multiprocessing import Pipe
from typing import Any

import pytest

from crkr.sim_worker.supervisor.pipe import Line
from crkr.sim_worker.worker.supervisor_link import Orders, Stopped


@pytest.fixture
def both_ends() -> Iterator[tuple[Orders, Line]]:
    """A worker's orders, and the launcher's end of its line."""
    ours, theirs = Pipe()
    with ours, theirs:
        yield Orders(Line(ours), 5.0), Line(theirs)


def test_epochs_are_judged_before_trials_and_in_the_order_they_ended(both_ends: tuple[Orders, Line]) -> None:
    orders, launcher = both_ends
    kinds = ["go", "judge", "go", "judge"]
    sent: list[dict[str, Any]] = [{"order": order, "number": number} for number, order in enumerate(kinds)]
    for message in sent:
        launcher.send(message)
    assert [orders.next() for _ in sent] == [sent[1], sent[3], sent[0], sent[2]]
    assert not orders.waiting()


def test_stop_overtakes_what_waits(both_ends: tuple[Orders, Line]) -> None:
    orders, launcher = both_ends
    for order in ("go", "judge", "stop"):
        launcher.send({"order": order})
    with pytest.raises(Stopped):
        orders.next()
