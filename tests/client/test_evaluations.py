"""What anybody may have written into a trial's info."""

from typing import Any

import numpy as np
import pytest

from crkr.client.evaluations import stated_epoch, success_by_criterion


@pytest.mark.parametrize("epoch", [None, "three", True, 1.0, -1, 2**31, [1], {}])
def test_what_is_no_epoch_is_none(epoch: Any) -> None:
    assert stated_epoch({"epoch": epoch}) is None
    assert stated_epoch({}) is None


def test_an_epoch_is_read_as_it_is() -> None:
    assert [stated_epoch({"epoch": epoch}) for epoch in (0, 30, 2**31 - 1)] == [0, 30, 2**31 - 1]


def test_success_is_told_by_criterion_where_the_skill_has_any() -> None:
    assert success_by_criterion(True, {"outcomes": {"paper": True, "strict": np.False_}}) == {
        "paper": True,
        "strict": False,
    }


@pytest.mark.parametrize("outcomes", [None, {}, "x", {"paper": "yes"}, {3: True}])
def test_success_stands_alone_where_there_are_no_criteria(outcomes: Any) -> None:
    assert success_by_criterion(True, {"outcomes": outcomes}) == {"success": True}
