"""More states than a message holds are asked about in several, and answered as one."""

import asyncio
from collections.abc import Callable, Iterator
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest

from crkr.client import AsyncClient, Client, Task
from crkr.protocol import NovelState, TaskSpec, Unavailable, most_states, random_ids, unpack

WIDTH = 100
STATES = np.random.default_rng(2).uniform(0.45, 0.55, (4096, WIDTH))


def spec(**settings: Any) -> TaskSpec:
    axes = [{"name": f"x{number}", "low": 0, "high": 1} for number in range(WIDTH)]
    return TaskSpec.from_dict({"name": f"wide-{uuid4()}", "state": axes, "goal": axes, **settings})


@pytest.fixture(scope="module")
def client(shared_endpoint: str) -> Iterator[Client]:
    with Client(shared_endpoint, timeout_s=60.0) as client:
        client.wait_until_ready(60.0)
        yield client


def taught(client: Client, **settings: Any) -> Task:
    task = client.create_task(spec(**settings))
    task.report(state=STATES[::1024], goal=STATES[::1024], cost=[0.1] * 4, success=[True] * 4, wait=True)
    return task


def test_a_large_batch_is_answered_as_its_parts_are(client: Client) -> None:
    task = taught(client)
    most = most_states(task.spec)
    assert most < len(STATES)
    ids = [UUID(bytes=one) for one in random_ids(len(STATES))]
    whole = task.predict(STATES, explore=True, trial_ids=ids)
    assert whole.goals.shape == STATES.shape
    assert whole.trial_ids == ids
    assert (whole.policy, whole.active, whole.model_version) == ("explore", 4, 5)
    for some in (slice(0, 64), slice(most - 32, most + 32), slice(4032, 4096)):
        part = task.predict(STATES[some], explore=True, trial_ids=ids[some])
        np.testing.assert_allclose(whole.goals[some], part.goals, rtol=0, atol=1e-9)
        np.testing.assert_allclose(whole.novelty[some], part.novelty, rtol=0, atol=1e-9)
        np.testing.assert_array_equal(whole.states[some], part.states)


def test_the_awaited_task_splits_as_well(client: Client) -> None:
    name = taught(client).name

    async def program() -> None:
        async with AsyncClient(client.endpoint, timeout_s=60.0) as other:
            answer = await other.task(name).predict(STATES)
            assert answer.goals.shape == STATES.shape
            assert len(set(answer.trial_ids)) == len(STATES)

    asyncio.run(program())


def test_a_state_that_is_too_novel_is_named_by_its_place_among_all(client: Client) -> None:
    task = taught(client, novel="refuse")
    states = np.repeat(STATES[:1], len(STATES), axis=0)
    states[4000] = 90.0
    with pytest.raises(NovelState) as caught:
        task.predict(states)
    assert caught.value.details["index"] == 4000
    assert "among states" in caught.value.message


def test_the_parts_have_one_deadline(make_peer: Callable[..., Any]) -> None:
    known = spec()
    most = most_states(known)

    def answer(number: int) -> object:
        key, payload, _ = peer.queries[number]
        if key.endswith("spec"):
            return {"spec": known.to_dict()}
        asked = unpack(payload)
        if asked["states"]["shape"][0] != most:
            return "hold"
        wide = {"shape": [most, WIDTH], "dtype": "<f8", "data": bytes(8 * most * WIDTH)}
        one = {"shape": [most], "dtype": "<f8", "data": bytes(8 * most)}
        rest = {"trial_ids": asked["trial_ids"], "model_version": 1, "active": 1, "policy": "mean"}
        return {"goals": wide, "means": wide, "sigmas": wide, "novelty": one, **rest}

    peer = make_peer(answer)
    with Client(peer.endpoint, timeout_s=1000.0) as client:
        task = client.task(known.name)
        assert task.spec == known
        with pytest.raises(Unavailable) as caught:
            task.predict(STATES, timeout_s=3.0)
        assert caught.value.details["tried_s"] < 30.0
    asked = {unpack(payload)["states"]["shape"][0] for key, payload, _ in peer.queries if key.endswith("predict")}
    assert asked == {most, len(STATES) - most}
