"""How many trials of how many, as people read it."""

import io

import pytest
from rich.console import Console

from crkr.sim_worker.supervisor.progress import Progress


@pytest.mark.parametrize(
    ("total", "done", "said"),
    [
        (1500, 1499, "learning: 1499 of 1500 trials"),
        (1500, 1500, "learning: 1500 of 1500 trials"),
        (1500, 1501, "learning: 1501 trials (1500 asked for)"),
        (None, 7, "learning: 7 trials"),
    ],
)
@pytest.mark.parametrize("terminal", [False, True])
def test_nobody_reads_of_more_trials_than_there_are(total: int | None, done: int, said: str, terminal: bool) -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=100)
    with Progress(console, "learning", total, "trials") as progress:
        progress.show(done, now=True)
    if terminal:
        assert said.removeprefix("learning: ") in text.getvalue()
    else:
        assert text.getvalue() == f"{said}\n"
