"""Progress of long work, as people and programs read it."""

import io

import pytest
from rich.console import Console

from crkr.client.cli.console import stderr
from crkr.client.cli.progress import Progress


def test_without_a_terminal_there_is_a_plain_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(stderr, "importing", 10, "") as bar:
        for done in range(10):
            bar.show(done)
    assert capsys.readouterr().err == ""  # it was soon over
    with Progress(stderr, "importing", 10, "", every_s=0.0) as bar:
        bar.show(4)
        bar.show(10)
    assert capsys.readouterr() == ("", "importing: 4 of 10\nimporting: 10 of 10\n")


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
def test_a_count_beyond_the_total_names_both(total: int | None, done: int, said: str, terminal: bool) -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=100)
    with Progress(console, "learning", total, "trials") as progress:
        progress.show(done, now=True)
    if terminal:
        assert said.removeprefix("learning: ") in text.getvalue()
    else:
        assert text.getvalue() == f"{said}\n"
