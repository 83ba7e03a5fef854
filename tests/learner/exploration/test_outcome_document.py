"""The page that tells users about outcomes, held to what the code does."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from crkr.learner import Learner
from crkr.learner.exploration.outcome_index import SEARCHED
from crkr.learner.exploration.sealed_trials import UNIT
from crkr.protocol import TaskSpec

PAGE = (Path(__file__).parents[3] / "docs" / "outcomes.md").read_text()


def test_the_settings_shown_are_the_defaults() -> None:
    [block] = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    shown: dict[str, Any] = tomllib.loads(block)
    axes = {name: [{"name": name, "low": 0, "high": 1}] for name in ("state", "goal")}
    spelt_out = TaskSpec.from_dict({"name": "t", **axes, **shown}, strict=True)
    del shown["exploration"]
    assert TaskSpec.from_dict({"name": "t", **axes, **shown}) == spelt_out
    Learner(spelt_out)


def test_the_number_of_trials_that_are_all_looked_through_is_the_one_told() -> None:
    told = f"newest {SEARCHED - UNIT:,} to {SEARCHED:,} trials".replace(",", " ")
    assert told in PAGE
