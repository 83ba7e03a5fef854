"""How awaited calls end: cancelled, closed, or left behind by their loop; and what goes on after them."""

import asyncio
import contextlib
import gc
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from processes import Processes
from small_tasks import practise, run, specification

from crkr.client import AsyncClient
from crkr.client.call_threads import TIMED_OUT, AwaitedCalls
from crkr.protocol import NoSamples, Unavailable

PATIENCE_S = 20.0


def test_cancelling_stops_the_wait_and_the_client_goes_on(start_server: Callable[..., Any]) -> None:
    server = start_server()

    async def program() -> None:
        async with AsyncClient(server.endpoint, timeout_s=PATIENCE_S, in_flight=2) as client:
            task = await client.create_task(specification())
            await practise(task)
            server.process.send_signal(signal.SIGSTOP)
            try:
                call = asyncio.create_task(task.predict([0.5, 0.5], timeout_s=1.5))
                await asyncio.wait([call], timeout=0.2)
                call.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await call
            finally:
                server.process.send_signal(signal.SIGCONT)
            for answer in await asyncio.gather(*[task.predict([0.5, 0.5]) for _ in range(20)]):
                assert answer.active == 30

    run(program())


def test_closing_ends_calls_in_progress_and_later_ones(start_server: Callable[..., Any]) -> None:
    server = start_server()

    async def program() -> None:
        client = AsyncClient(server.endpoint, timeout_s=PATIENCE_S)
        task = await client.create_task(specification())
        server.process.send_signal(signal.SIGSTOP)
        try:
            call = asyncio.create_task(task.status())
            await asyncio.wait([call], timeout=0.2)
            await client.close()
            with pytest.raises(Unavailable):
                await call
        finally:
            server.process.send_signal(signal.SIGCONT)
        with pytest.raises(Unavailable):
            await task.status()
        await client.close()

    run(program())


def test_a_subscription_ends_with_its_client(shared_endpoint: str) -> None:
    async def program() -> None:
        client = AsyncClient(shared_endpoint)
        task = await client.create_task(specification())
        notices = await task.subscribe(("model",))
        await client.close()
        assert [message async for message in notices] == []
        await notices.close()

    run(program())


def test_one_client_serves_loops_one_after_another(
    start_server: Callable[..., Any], caplog: pytest.LogCaptureFixture, processes: Processes
) -> None:
    """Also after a loop that ended while calls were in progress and others waited for their turn."""
    server = start_server()
    client = AsyncClient(server.endpoint, timeout_s=PATIENCE_S, in_flight=2)
    name = specification()

    async def ask() -> None:
        task = await client.create_task(name)
        await practise(task)
        for answer in await asyncio.gather(*[task.predict([0.5, 0.5]) for _ in range(20)]):
            assert answer.active == 30

    async def leave() -> None:
        calls = [asyncio.create_task(client.info(timeout_s=1.0)) for _ in range(5)]
        await asyncio.wait(calls, timeout=0.2)

    run(ask())
    server.process.send_signal(signal.SIGSTOP)
    try:
        run(leave())
        processes.wait_until(lambda: client.in_progress == 0)
    finally:
        server.process.send_signal(signal.SIGCONT)
    name = specification()
    run(ask())
    run(client.close())
    assert not [record for record in caplog.records if record.levelname in ("WARNING", "ERROR")]


def test_a_receive_that_is_cancelled_loses_no_publication(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            task = await client.create_task(specification())
            async with await task.subscribe(("model",)) as notices:
                for _ in range(200):  # until the router knows of the subscription
                    await practise(task, 1)
                    if await notices.receive(0.05) is not None:
                        break
                for _ in range(3):
                    while await notices.receive(0.2) is not None:
                        pass
                    with pytest.raises(TIMED_OUT):
                        await asyncio.wait_for(notices.receive(PATIENCE_S), 0.05)
                    await practise(task, 1)
                    last = (await task.status())["model_version"]
                    message = await notices.receive(PATIENCE_S)
                    assert message is not None
                    assert message[1]["version"] == last

    run(program())


def test_closing_at_once_ends_calls_by_an_error_and_cancels_none(shared_endpoint: str) -> None:
    async def program() -> None:
        for _ in range(30):
            client = AsyncClient(shared_endpoint, in_flight=3)
            calls = [asyncio.create_task(client.info()) for _ in range(6)]
            await asyncio.wait(calls, timeout=0.0)
            await asyncio.gather(client.close(), client.close())
            for outcome in await asyncio.gather(*calls, return_exceptions=True):
                assert isinstance(outcome, dict | Unavailable), outcome

    run(program())


def test_closing_does_not_wait_for_the_threads_of_the_loop(shared_endpoint: str) -> None:
    async def program() -> None:
        done = threading.Event()
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        async with AsyncClient(shared_endpoint) as client:
            task = await client.create_task(specification())
            async with await task.subscribe():
                waiting = asyncio.create_task(asyncio.to_thread(done.wait, PATIENCE_S))
        done.set()
        assert await waiting

    run(program())


def test_a_forgotten_client_ends_its_threads(shared_endpoint: str, processes: Processes) -> None:
    before = set(threading.enumerate())

    async def program() -> None:
        client = AsyncClient(shared_endpoint)
        task = await client.create_task(specification())
        with contextlib.suppress(NoSamples):
            await task.predict([0.5, 0.5])
        assert set(threading.enumerate()) > before

    def has_ended() -> bool:
        gc.collect()  # a thread may have held the last call's error until now
        return set(threading.enumerate()) <= before

    run(program())
    processes.wait_until(has_ended)


def test_many_cancellations_leave_the_client_usable(shared_endpoint: str) -> None:
    async def program() -> None:
        rng = np.random.default_rng(3)
        async with AsyncClient(shared_endpoint, in_flight=4) as client:
            task = await client.create_task(specification())
            await practise(task)
            for _ in range(20):
                calls = [asyncio.create_task(task.predict([0.5, 0.5])) for _ in range(50)]
                await asyncio.wait(calls, timeout=rng.uniform(0.0, 0.01))
                for number in rng.permutation(50):
                    calls[number].cancel()
                for outcome in await asyncio.gather(*calls, return_exceptions=True):
                    assert not isinstance(outcome, Exception), outcome
            for answer in await asyncio.gather(*[task.predict([0.5, 0.5]) for _ in range(50)]):
                assert answer.active == 30

    run(program())


def test_many_cancellations_leave_every_slot_free() -> None:
    """Four calls that wait for each other end only if none of the four slots was lost."""
    calls, together, release = AwaitedCalls(4, PATIENCE_S), threading.Barrier(4), threading.Event()

    def hold(timeout_s: float) -> bool:
        return release.wait(timeout_s)

    def meet(timeout_s: float) -> int:
        return together.wait(timeout_s)

    async def program() -> None:
        rng = np.random.default_rng(3)
        for _ in range(20):
            release.clear()
            held = [asyncio.create_task(calls.run(hold)) for _ in range(20)]
            await asyncio.wait(held, timeout=rng.uniform(0.0, 0.01))
            for number in rng.permutation(20):
                held[number].cancel()
            release.set()
            for outcome in await asyncio.gather(*held, return_exceptions=True):
                assert outcome is True or isinstance(outcome, asyncio.CancelledError)
        assert sorted(await asyncio.gather(*[calls.run(meet) for _ in range(4)])) == [0, 1, 2, 3]

    run(program())
    calls.close()


def test_an_error_of_the_program_passes_through(shared_endpoint: str) -> None:
    async def program() -> None:
        calls = []

        async def fail() -> None:
            async with AsyncClient(shared_endpoint) as client:
                task = await client.create_task(specification())
                async with await task.subscribe():
                    calls.append(asyncio.create_task(task.status()))
                    raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            await fail()
        assert isinstance((await asyncio.gather(*calls, return_exceptions=True))[0], dict | Unavailable)

    run(program())
