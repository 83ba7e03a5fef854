"""What was predicted of the newest trials is compared with what came of them, whatever else `info` holds."""

from collections.abc import Callable
from typing import Any
from uuid import UUID

import numpy as np
import pytest

from crkr.dashboard.predictions import EXPECTED, HELD, NEWEST, OBSERVED, PredictionRecord
from crkr.protocol import TaskSpec, Trial

MakeTrial = Callable[..., Trial]


@pytest.fixture
def trial() -> MakeTrial:
    axis = {"name": "x", "low": -1.0, "high": 1.0}
    outcome = [{"name": name, "tolerance": 0.1} for name in ("side", "far")]
    spec = TaskSpec.from_dict({"name": "aim", "state": [axis], "goal": [axis], "outcome": outcome})

    def make(predicted: Any, success: bool = True, measured: Any = None, kind: str = "trial") -> Trial:
        info = {"predicted": predicted}
        content: dict[str, Any] = {
            "id": UUID(int=1),
            "state": [0.0],
            "goal": [0.0],
            "cost": 0.5,
            "success": success,
            "kind": kind,
        }
        return Trial.create(spec, **content, outcome=measured, info=info)

    return make


def test_shares_are_those_of_the_newest_trials(trial: MakeTrial) -> None:
    rng, record, trials = np.random.default_rng(0), PredictionRecord(), []
    for _ in range(NEWEST + 70):
        chance, off = float(rng.uniform()), rng.normal(size=2)
        off[1] = np.nan if rng.uniform() < 0.3 else off[1]
        trials.append((chance, bool(rng.uniform() < chance), off))
        predicted = {"success": chance, "outcome": [1.0, 2.0], "sd": [0.5, 0.25]}
        record.add(trial(predicted, trials[-1][1], [1.0, 2.0] + off * [0.5, 0.25]))
    newest = trials[-NEWEST:]
    seen = np.array([off for _, _, off in newest])
    shares = record.shares()
    assert shares[EXPECTED] == pytest.approx(np.mean([chance for chance, _, _ in newest]))
    assert shares[OBSERVED] == pytest.approx(np.mean([won for _, won, _ in newest]))
    assert shares[HELD] == pytest.approx((np.abs(seen) <= 1.6449).sum() / (~np.isnan(seen)).sum())


@pytest.mark.parametrize(
    "predicted",
    [None, 3, {}, {"success": float("nan")}, {"success": "high"}, {"success": 2.0}, {"outcome": [1.0, 2.0]},
     {"outcome": [1.0], "sd": [1.0]}, {"outcome": "ab", "sd": "cd"}, {"outcome": [[1.0]], "sd": [None]}],
)  # fmt: skip
def test_what_cannot_be_read_is_left_out(trial: MakeTrial, predicted: Any) -> None:
    record = PredictionRecord()
    record.add(trial(predicted, measured=[0.0, 0.0]))
    assert record.shares() == {}


def test_huge_numbers_do_no_harm(trial: MakeTrial) -> None:
    record = PredictionRecord()
    record.add(trial({"outcome": [-1e308, 0.0], "sd": [0.0, 1e308]}, measured=[1e308, 0.0]))
    assert record.shares() == {HELD: 0.5}
    record.add(trial({"outcome": [0.0, 0.0], "sd": [1.0, 1.0]}, success=False, measured=[0.0, 0.0], kind="evaluation"))
    assert record.shares() == {HELD: 0.75}
