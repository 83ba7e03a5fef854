"""The figures of `crkr bench sim` belong to a real run."""

import json

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.bench.commands import sim
from crkr.experiments.bench.sim import environment_times
from crkr.sim_worker.skill import SkillOptions
from crkr.sim_worker.table_tennis.table_tennis import TableTennis


def test_the_command_prints_every_ratio() -> None:
    app = Typer()
    app.command()(sim)
    result = CliRunner().invoke(app, ["--trials", "5", "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["what"]: row for row in json.loads(result.stdout)}
    ratio = rows["a contact trial with learning / its bare steps"]
    assert ratio["value"] > 1
    assert ratio["value"] * ratio["detail"]["bare steps ms"] == pytest.approx(ratio["detail"]["trial ms"])
    assert 0 <= rows["same strict verdict as analytic: contact"]["value"] <= 1
    assert sum(row["bar"] is not None for row in rows.values()) == 4


def test_the_throw_is_measured_beside_table_tennis() -> None:
    app = Typer()
    app.command()(sim)
    result = CliRunner().invoke(app, ["--skill", "throw", "--trials", "5", "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["what"]: row for row in json.loads(result.stdout)}
    cost = rows["a contact trial of the throw / of table tennis"]
    assert cost["value"] * cost["detail"]["stroke ms"] == pytest.approx(cost["detail"]["throw ms"])
    agreed = rows["same strict verdict as analytic: contact"]
    assert 0.6 <= agreed["value"] <= 1
    assert agreed["detail"]["landings apart, median m"] < 0.02
    assert CliRunner().invoke(app, ["--skill", "reach"]).exit_code == 2


def test_the_same_trials_are_timed_in_every_environment() -> None:
    skill = TableTennis(SkillOptions(environment="contact"), traces=False)
    shown = skill.demonstrations(3, np.random.default_rng(0))
    balls, goals = np.array([one.state for one in shown]), np.array([one.goal for one in shown])
    times = environment_times(balls, goals, 30)
    assert set(times) == {"analytic", "hybrid", "contact", "bare", "batched"}
    assert min(times.values()) > 0
