"""Streams of random numbers."""

from collections.abc import Callable

import numpy as np
import pytest

from crkr.sim_worker.randomness import (
    demonstration_rng,
    evaluation_rng,
    fresh_rng,
    training_rng,
    unpredictable_seed,
    worker_seed,
)

STREAMS: list[Callable[[int], np.random.Generator]] = [
    demonstration_rng,
    lambda seed: evaluation_rng(seed, 0),
    lambda seed: evaluation_rng(seed, 1),
    lambda seed: fresh_rng(seed, 0),
    lambda seed: fresh_rng(seed, 1),
    lambda seed: training_rng(seed, 0),
    lambda seed: training_rng(seed, 7),
]


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_no_two_streams_of_a_seed_are_the_same(seed: int) -> None:
    draws = [tuple(stream(seed).integers(0, 2**62, 4)) for stream in STREAMS]
    assert len(set(draws)) == len(draws)


@pytest.mark.parametrize("stream", STREAMS)
def test_a_stream_is_a_function_of_its_seed(stream: Callable[[int], np.random.Generator]) -> None:
    assert stream(5).integers(2**62) == stream(5).integers(2**62) != stream(6).integers(2**62)


def test_workers_of_a_supervisor_have_seeds_of_their_own() -> None:
    seeds = {worker_seed(seed, index) for seed in range(20) for index in range(20)}
    assert len(seeds) == 400
    assert all(0 <= seed < 2**31 for seed in seeds)


def test_an_unpredictable_seed_is_another_one_each_time() -> None:
    assert unpredictable_seed() != unpredictable_seed()
