"""When a server opens its Zenoh session again, and when it gives the process up."""

import threading

import pytest
from processes import Processes

from crkr.server.session_renewal import SessionRenewal

PATIENCE_S = 30.0


@pytest.mark.parametrize("renews", [True, False])
def test_a_session_that_is_broken_is_renewed_and_where_that_does_not_help_the_process_is_given_up(
    renews: bool, processes: Processes
) -> None:
    broken, done = threading.Event(), []

    def renew() -> None:
        done.append("renewed")
        if renews:
            broken.clear()

    def give_up() -> None:
        done.append("given up")
        broken.clear()

    renewal = SessionRenewal(renew, broken.is_set, give_up)
    renewal.start()
    broken.set()
    processes.wait_until(lambda: not broken.is_set())
    renewal.stop(PATIENCE_S)
    assert done == (["renewed"] if renews else ["renewed", "given up"])


def test_panics_that_pass_do_not_renew_the_session() -> None:
    renewed: list[None] = []
    renewal = SessionRenewal(lambda: renewed.append(None), lambda: False, lambda: None)
    renewal.start()
    for _ in range(100):  # at once
        renewal.note_panic(RuntimeError("called `Option::unwrap()` on a `None` value"))
    renewal.stop(PATIENCE_S)
    assert renewed == []


def test_a_panic_over_a_poisoned_lock_renews_the_session_at_once(processes: Processes) -> None:
    renewed: list[None] = []
    renewal = SessionRenewal(lambda: renewed.append(None), lambda: False, lambda: None)
    renewal.start()
    renewal.note_panic(RuntimeError("called `Result::unwrap()` on an `Err` value: PoisonError { .. }"))
    processes.wait_until(lambda: renewed)
    renewal.stop(PATIENCE_S)
    assert renewed == [None]
