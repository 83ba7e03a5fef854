from __future__ import annotations

from hashlib import shake_128
from uuid import RFC_4122, UUID, uuid4

import numpy as np
from scipy.stats import kstest

from crkr.learner import draw_ids, uniforms


def test_uniforms_are_those_of_the_documented_hash() -> None:
    trial = UUID("12345678-9abc-4def-8123-456789abcdef")
    stream = shake_128((7).to_bytes(8, "little") + trial.bytes).digest(24)
    words = [int.from_bytes(stream[i : i + 8], "little") for i in (0, 8, 16)]
    expected = [((word >> 12) + 0.5) / 2**52 for word in words]
    np.testing.assert_array_equal(uniforms(7, [trial], 3), [expected])


def test_uniforms_depend_on_seed_and_trial_only() -> None:
    first, second = uuid4(), uuid4()
    both = uniforms(1, [first, second], 5)
    np.testing.assert_array_equal(both[1:], uniforms(1, [second], 5))
    assert not np.array_equal(both[0], both[1])
    assert not np.array_equal(both, uniforms(2, [first, second], 5))


def test_uniforms_are_uniform_and_strictly_inside() -> None:
    u = uniforms(0, draw_ids("test", 2000), 13)
    assert u.min() > 0
    assert u.max() < 1
    assert kstest(u.ravel(), "uniform").pvalue > 1e-3
    assert np.abs(np.corrcoef(u.T) - np.eye(13)).max() < 0.1


def test_derived_ids_are_valid_distinct_and_repeatable() -> None:
    ids = draw_ids("task/1", 500)
    assert len(set(ids)) == 500
    assert ids == draw_ids("task/1", 500)
    assert not set(ids) & set(draw_ids("task/2", 500))
    for derived in ids:
        assert derived.version == 8
        assert derived.variant == RFC_4122
        assert UUID(bytes=derived.bytes) == derived
        assert UUID(str(derived)) == derived
        assert derived.is_safe is UUID(int=0).is_safe


def test_few_derived_ids_are_the_first_of_many() -> None:
    many = draw_ids("task/1", 500)
    for count in (0, 1, 2, 15, 16, 17, 499):
        assert draw_ids("task/1", count) == many[:count]
