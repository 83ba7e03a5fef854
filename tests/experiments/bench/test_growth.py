"""The benchmark of growth, as far as it takes a moment."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.bench.commands import growth
from crkr.experiments.bench.growth import measure
from crkr.experiments.bench.scale import measure_lag, measure_places, measure_trials


def test_looks_at_the_count_are_measured_on_real_servers(tmp_path: Path) -> None:
    found = list(measure(tmp_path, ("polls",), polls=300))
    assert [one.bar for one in found] == [1.2, 0.05]
    assert all(one.value > 0 for one in found)


def test_a_server_that_is_offered_successes_tells_how_far_it_is_behind(tmp_path: Path) -> None:
    behind, stored = measure_lag(tmp_path, 100, 2.0)
    assert behind.value >= 0
    assert behind.behind["refused"] == 0
    assert stored.value > 0


def test_the_cost_of_a_trial_is_measured_with_real_workers(tmp_path: Path) -> None:
    [cost] = measure_trials(tmp_path, workers=1, warm=1, counted_s=2.0)
    assert cost.value > 0
    assert cost.behind["a second"] == cost.behind["trials"] / 2


@pytest.mark.campaign
@pytest.mark.timeout(600)
def test_places_on_ray_are_compared_with_supervisors(tmp_path: Path) -> None:
    [found] = measure_places(tmp_path, turns=1)
    assert found.value > 0


@pytest.mark.parametrize("part", ["inserts", ""])
def test_an_unknown_part_is_refused_with_the_known_ones(part: str) -> None:
    app = Typer()
    app.command()(growth)
    result = CliRunner().invoke(app, ["--part", part], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert "parts are insert, learn, guided, polls, lag, trials, places, ten-million" in result.output
