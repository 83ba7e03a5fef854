"""Long work says how far it is, where a program may read it too."""

import io

import pytest
from rich.console import Console

from crkr.client.cli import progress as module
from crkr.client.cli.console import stderr
from crkr.client.cli.progress import ProgressBar


def test_without_a_terminal_there_is_a_plain_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with ProgressBar(stderr, "importing", 10, "trials") as bar:
        for done in range(10):
            bar.show(done)
    assert capsys.readouterr().err == ""  # it was soon over
    monkeypatch.setattr(module, "_EVERY_S", 0.0)
    with ProgressBar(stderr, "importing", 10, "trials") as bar:
        bar.show(4)
        bar.show(10)
    assert capsys.readouterr() == ("", "importing: 4 of 10 trials\nimporting: 10 of 10 trials\n")


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
def test_a_count_never_exceeds_its_total(total: int | None, done: int, said: str, terminal: bool) -> None:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=100)
    with ProgressBar(console, "learning", total, "trials") as bar:
        bar.show(done, now=True)
    if terminal:
        assert said.removeprefix("learning: ") in text.getvalue()
    else:
        assert text.getvalue() == f"{said}\n"
