"""The command, as a user runs it: the more a report says, the sooner a throw is learned."""

import json

from typer import Typer
from typer.testing import CliRunner

from crkr.experiments.learning.labels import labels


def test_a_throw_is_learned_from_nothing_by_hits_and_misses_and_sooner_by_the_measured_miss() -> None:
    app = Typer()
    app.command()(labels)
    first, second = (CliRunner().invoke(app, ["--seeds", "1", "--trials", "60", "--json"]) for _ in range(2))
    assert first.exit_code == 0, first.output
    assert first.stdout == second.stdout
    hits = {(row["report"], row["trials"]): row["mean"] for row in json.loads(first.stdout)["hits"]}
    assert hits["outcome", 60] > 0.95
    assert hits["label", 30] < hits["label", 60] < hits["outcome", 60]
    table = CliRunner().invoke(app, ["--seeds", "1", "--trials", "20"]).stdout
    assert "share of hits" in table
