"""Call threads run every call at once, are used again, and keep nothing that was handed to them."""

import functools
import gc
import threading
import weakref
from concurrent.futures import Future
from typing import Any

import pytest

from crkr.client.call_threads import CallThreads

PATIENCE_S = 20.0


class Thing:
    def fail(self) -> None:
        raise ZeroDivisionError

    def work(self) -> "Thing":
        return self


def test_calls_run_at_once_and_their_threads_are_used_again() -> None:
    threads, together = CallThreads("together"), threading.Barrier(5)
    for _ in range(50):
        waiting: list[Future[int]] = [threads.submit(lambda: together.wait(PATIENCE_S)) for _ in range(5)]
        assert sorted(each.result(PATIENCE_S) for each in waiting) == [0, 1, 2, 3, 4]
    mine = [thread for thread in threading.enumerate() if thread.name.startswith("together-")]
    assert len(mine) == 5
    assert all(thread.daemon for thread in mine)
    threads.close()
    for thread in mine:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.mark.parametrize("name", ["fail", "work"])
def test_an_idle_thread_keeps_neither_call_nor_result_nor_error(name: str) -> None:
    threads, thing = CallThreads("idle"), Thing()
    future: Future[Any] = threads.submit(getattr(thing, name))
    future.exception(PATIENCE_S)
    gone, ended = weakref.ref(thing), threading.Event()
    weakref.finalize(thing, ended.set)
    gc.disable()  # nothing may depend on it
    try:
        del thing, future
        assert ended.wait(PATIENCE_S)
        assert gone() is None
    finally:
        gc.enable()
        threads.close()


def test_a_call_that_was_cancelled_before_its_turn_is_not_made() -> None:
    made: list[int] = []
    threads = CallThreads("cancelled")
    futures: list[Future[None]] = []
    for number in range(200):
        futures.append(threads.submit(functools.partial(made.append, number)))
        futures[-1].cancel()
    threads.close()
    for thread in threading.enumerate():
        if thread.name.startswith("cancelled-"):
            thread.join(PATIENCE_S)
    assert sorted(made) == [number for number, future in enumerate(futures) if not future.cancelled()]
