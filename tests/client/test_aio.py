"""Awaited calls do what the blocking ones do, many at once, and leave the loop to others meanwhile."""

import asyncio
import gc
import signal
import threading
import weakref
from collections.abc import Callable, Coroutine
from typing import Any

import numpy as np
import pytest
from small_tasks import practise, run, specification

from crkr.client import AsyncClient, Client, Task
from crkr.protocol import Conflict, CrkrError, Invalid, NoSamples, Unavailable, UnknownTask

PATIENCE_S = 20.0


def test_a_task_is_made_taught_asked_and_read(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            assert (await client.wait_until_ready(PATIENCE_S))["protocol"] == 1
            task = await client.create_task(specification())
            assert task.name in {entry["spec"].name for entry in await client.tasks()}
            await practise(task)
            answer = await task.predict([0.5, 0.5], explore=True)
            receipt = await task.report(answer, cost=0.3, success=True)
            ids = [entry.trial.id async for entry in task.iter_samples()]
            assert (len(ids), ids[-1]) == (31, answer.trial_id)
            assert (await task.explain([0.5, 0.5])).novelty <= 1.0
            assert (await task.recost([answer.trial_id], [0.9]))["changed"] == 1
            assert (await task.configure({"budget": 9}, timeout_s=PATIENCE_S))["seq"] > receipt.seqs[-1]
            assert (await task.status())["active"] == 9
            assert (await task.amend(answer.trial_id, success=False, cost=1.0))["changed"] == 1
            [newest] = await task.trials(last=1)
            assert (newest.trial.id, newest.trial.success) == (answer.trial_id, False)
            assert (await task.undo())["undone"] == "amend"
            assert (await task.rollback(receipt.seqs[-1]))["to"] == receipt.seqs[-1]
            assert (await task.rename(f"{task.name}-2"))["name"] == f"{task.name}-2"
            assert (await client.task(f"{task.name}-2").delete())["deleted"] is True

    run(program())


def test_many_calls_at_once_are_answered_as_one_by_one(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint, in_flight=16) as client:
            task = await client.create_task(specification())
            await practise(task)
            states = np.random.default_rng(2).uniform(0, 1, (400, 2))
            answers = await asyncio.gather(*[task.predict(state) for state in states])
            together = await task.predict(states)
            for answer, goals in zip(answers, together.goals, strict=True):
                np.testing.assert_allclose(answer.goals, goals, rtol=0, atol=1e-9)

    run(program())


def test_errors_are_those_of_the_blocking_client(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            task = await client.create_task(specification())
            wrong: list[tuple[Coroutine[Any, Any, Any], type[CrkrError]]] = [
                (task.predict([0.5, 0.5]), NoSamples),
                (task.predict([0.5]), Invalid),
                (task.status(timeout_s=-1.0), Invalid),
                (client.create_task({**specification(), "name": task.name, "seed": 5}), Conflict),
                (client.task("nowhere").status(), UnknownTask),
            ]
            for call, error in wrong:
                with pytest.raises(error):
                    await call

    run(program())


def test_a_call_that_got_no_thread_keeps_no_other_from_its_turn(
    shared_endpoint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    async def program() -> None:
        async with AsyncClient(shared_endpoint, in_flight=1) as client:
            with monkeypatch.context() as patch:
                patch.setattr(threading.Thread, "start", refuse)
                with pytest.raises(RuntimeError, match="new thread"):
                    await client.info()
            assert (await client.info(timeout_s=PATIENCE_S))["protocol"] == 1

    run(program())


def test_a_loop_that_is_over_is_not_kept_although_calls_waited_in_it(shared_endpoint: str) -> None:
    client = AsyncClient(shared_endpoint, in_flight=1)
    loops: list[weakref.ref[asyncio.AbstractEventLoop]] = []

    async def program() -> None:
        loops.append(weakref.ref(asyncio.get_running_loop()))
        await asyncio.gather(client.info(), client.info(), client.info())

    for _ in range(4):
        run(program())
    gc.collect()
    assert sum(loop() is not None for loop in loops) <= 1
    run(client.close())


@pytest.mark.parametrize("in_flight", [0, -1, 1.5, True])
def test_a_number_of_calls_that_makes_no_sense_is_refused(in_flight: Any) -> None:
    with pytest.raises(Invalid, match="in_flight"):
        AsyncClient(in_flight=in_flight)


def test_the_loop_goes_on_and_every_call_ends_by_its_deadline_while_the_server_stands_still(
    start_server: Callable[..., Any],
) -> None:
    server = start_server()

    async def program() -> None:
        async with AsyncClient(server.endpoint, timeout_s=PATIENCE_S, in_flight=4) as client:
            task = await client.create_task(specification())
            await practise(task)
            server.process.send_signal(signal.SIGSTOP)
            try:
                deadlines = [2.0] * 4 + [0.5] * 8
                calls = [asyncio.create_task(task.predict([0.5, 0.5], timeout_s=time_s)) for time_s in deadlines]
                waiting = asyncio.gather(*calls, return_exceptions=True)
                turns = 0
                while not waiting.done():
                    await asyncio.wait([waiting], timeout=0.01)
                    turns += 1
                errors = await waiting
            finally:
                server.process.send_signal(signal.SIGCONT)
            assert all(isinstance(error, Unavailable) for error in errors), errors
            assert ["in progress" in str(error) for error in errors] == [False] * 4 + [True] * 8
            assert turns > 10
            assert (await task.predict([0.5, 0.5])).active == 30

    run(program())


def test_publications_arrive_in_order_while_others_call(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            task = await client.create_task(specification())
            async with await task.subscribe(("model",)) as notices:
                for _ in range(200):  # until the router knows of the subscription
                    await practise(task, 1)
                    if await notices.receive(0.05) is not None:
                        break
                for _ in range(10):
                    await practise(task, 1)
                versions = []
                last = (await task.status())["model_version"]
                async for topic, message in notices:
                    assert topic == "model"
                    versions.append(message["version"])
                    if versions[-1] == last:
                        break
                assert versions == sorted(versions)
                assert notices.dropped == 0
            assert await notices.receive(1.0) is None

    run(program())


def test_several_may_receive_at_once_and_each_publication_goes_to_one(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            task = await client.create_task(specification())
            async with await task.subscribe(("model",)) as notices:
                for _ in range(200):
                    await practise(task, 1)
                    if await notices.receive(0.05) is not None:
                        break
                while await notices.receive(0.2) is not None:
                    pass
                readers = [asyncio.create_task(notices.receive(PATIENCE_S)) for _ in range(4)]
                for _ in readers:
                    await practise(task, 1)
                found = [message for message in await asyncio.gather(*readers) if message is not None]
                assert len({message["version"] for _, message in found}) == 4

    run(program())


def test_it_waits_for_a_server(start_server: Callable[..., Any], free_port: int) -> None:
    async def program() -> None:
        async with AsyncClient(f"tcp/127.0.0.1:{free_port}") as client:
            assert repr(client) == f"AsyncClient('tcp/127.0.0.1:{free_port}')"
            assert repr(client.task("lob")) == "AsyncTask('lob')"
            with pytest.raises(Unavailable):
                await client.wait_until_ready(0.3)
            waiting = asyncio.create_task(client.wait_until_ready(PATIENCE_S))
            await asyncio.to_thread(start_server, port=free_port)
            assert (await waiting)["protocol"] == 1

    run(program())


def test_the_blocking_task_beneath_gives_the_rest(shared_endpoint: str) -> None:
    async def program() -> None:
        async with AsyncClient(shared_endpoint) as client:
            assert isinstance(client.blocking, Client)
            task = await client.create_task(specification())
            await practise(task)
            assert isinstance(task.blocking, Task)
            with await asyncio.to_thread(task.blocking.mirror) as mirror:
                assert mirror.predict([0.5, 0.5]).active == 30

    run(program())
