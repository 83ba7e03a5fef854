from __future__ import annotations

from collections.abc import Callable
from typing import Any
from uuid import UUID, uuid5

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crkr.learner.samples.id_index import IdIndex, id_words
from crkr.learner.samples.store import SampleStore
from crkr.protocol import Conflict, Invalid, TaskSpec, Trial

SPACE = UUID(int=1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.binary(min_size=16, max_size=16), unique=True, max_size=600))
def test_index_finds_what_a_dict_finds(ids: list[bytes]) -> None:
    index, words = IdIndex(), np.array([id_words(value) for value in ids], dtype=np.uint64).reshape(-1, 2)
    for row in range(len(ids)):
        index.add(row, words[: row + 1])
    truth = {value: row for row, value in enumerate(ids)}
    for value in [*ids, bytes(16), b"\xff" * 16]:
        assert index.find(id_words(value), words) == truth.get(value)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.binary(min_size=16, max_size=16), unique=True, max_size=600), st.integers(0, 600))
def test_ids_entered_together_are_found_like_ids_entered_one_by_one(ids: list[bytes], first: int) -> None:
    index, words = IdIndex(), np.array([id_words(value) for value in ids], dtype=np.uint64).reshape(-1, 2)
    assert index.extend(words[:first]) is None
    assert index.extend(words) is None
    assert [index.find(id_words(value), words) for value in ids] == list(range(len(ids)))
    if ids:
        repeated = np.concatenate([words, words[:1]])
        assert index.extend(repeated) == len(ids)


@pytest.mark.parametrize("shift", range(0, 128, 8))
def test_ids_that_count_up_in_any_byte_spread_over_the_table(shift: int) -> None:
    ids = [(number << shift) % 2**128 for number in range(1, 200)]
    ids += [(number << shift + 8) % 2**128 for number in range(200, 4000)]
    distinct = list(dict.fromkeys(ids))
    words = np.array([id_words(one.to_bytes(16, "big")) for one in distinct], dtype=np.uint64)
    index = IdIndex()
    index.extend(words)
    longest = last = 0
    for home in sorted(index.home((low, high)) for low, high in words.tolist()):
        last = max(last + 1, home)  # the next free place
        longest = max(longest, last - home)
    assert longest < 64


def test_index_copes_with_ids_that_share_a_slot() -> None:
    # Few words: searches meet each other on the way.
    words = np.array([(number, number) for number in range(2000)], dtype=np.uint64)
    index = IdIndex()
    for row in range(2000):
        index.add(row, words)
    assert [index.find((number, number), words) for number in (0, 1, 999, 1999)] == [0, 1, 999, 1999]
    assert index.find((2000, 2000), words) is None


def trial(spec: TaskSpec, number: int, **fields: object) -> Trial:
    values: dict[str, Any] = {"state": [0.1, 0.2], "goal": [0.0, 0.5], "cost": 0.25, "success": True, **fields}
    return Trial.create(spec, id=uuid5(SPACE, str(number)), **values)


def test_ids_come_back_as_they_were(make_spec: Callable[..., TaskSpec]) -> None:
    spec, store = make_spec(), SampleStore(2, 2)
    trials = [trial(spec, number) for number in range(300)]
    for seq, one in enumerate(trials, start=2):
        store.append(seq, one)
    assert store.ids(np.array([7, 299, 0])) == [trials[7].id, trials[299].id, trials[0].id]
    assert store.rows_of([trials[5].id, trials[4].id]) == [5, 4]
    with pytest.raises(Invalid, match="1 unknown ids"):
        store.rows_of([trials[5].id, uuid5(SPACE, "never")])


def test_the_same_content_is_recognised_after_a_change_of_cost(make_spec: Callable[..., TaskSpec]) -> None:
    spec, store = make_spec(), SampleStore(2, 2)
    store.append(2, trial(spec, 0))
    store.recost(0, 0.75)
    assert store.original(trial(spec, 0, worker="another")) == 0
    with pytest.raises(Conflict, match="reported before with other content"):
        store.original(trial(spec, 0, cost=0.75))


@pytest.mark.parametrize(
    "change", [{"state": [0.1, -0.2]}, {"goal": [0.0, 0.4]}, {"success": False}, {"kind": "evaluation"}, {"cost": 0.0}]
)
def test_any_other_content_is_a_conflict(make_spec: Callable[..., TaskSpec], change: dict[str, object]) -> None:
    spec, store = make_spec(), SampleStore(2, 2)
    store.append(2, trial(spec, 0))
    with pytest.raises(Conflict):
        store.original(trial(spec, 0, **change))
