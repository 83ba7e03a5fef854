"""The benchmark of growth, as far as it takes a moment."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.bench.commands import growth
from crkr.experiments.bench.growth import measure


def test_looks_at_the_count_are_measured_on_real_servers(tmp_path: Path) -> None:
    found = list(measure(tmp_path, ("polls",), polls=300))
    assert [one.bar for one in found] == [1.2, 0.05]
    assert all(one.value > 0 for one in found)


@pytest.mark.parametrize("part", ["inserts", ""])
def test_an_unknown_part_is_refused_with_the_known_ones(part: str) -> None:
    app = Typer()
    app.command()(growth)
    result = CliRunner().invoke(app, ["--part", part], env={"COLUMNS": "200"})
    assert result.exit_code == 2
    assert "parts are insert, learn, guided, polls, ten-million" in result.output
