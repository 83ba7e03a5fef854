"""The bench's figures belong to a real run."""

import json

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.bench.sim import sim
from crkr.experiments.bench.sim_measure import worst_violation
from crkr.sim_worker.primitives.bench_primitive import draw_goals
from crkr.sim_worker.primitives.stroke import JointLimits

ARM = JointLimits(np.full(6, -3.0), np.full(6, 3.0), np.full(6, 2.5), np.full(6, 25.0))


def test_the_command_prints_every_ratio() -> None:
    app = Typer()
    app.command()(sim)
    result = CliRunner().invoke(app, ["--trials", "5", "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["what"]: row for row in json.loads(result.stdout)}
    ratio = rows["a contact trial with learning / its bare steps"]
    assert ratio["value"] > 1
    assert ratio["value"] * ratio["detail"]["bare steps ms"] == pytest.approx(ratio["detail"]["trial ms"])
    worst = rows["accepted swings: worst departure from goal or limits"]
    assert worst["value"] <= 1e-6
    assert worst["reached"]
    assert sum(row["bar"] is not None for row in rows.values()) == 6


def test_drawn_swings_keep_their_goals_and_limits() -> None:
    goals = draw_goals(ARM, np.random.default_rng(1), 20)
    assert 0 <= worst_violation(ARM, goals) <= 1e-6
