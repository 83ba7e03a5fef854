"""Long work says how far it is, where a program may read it too."""

import pytest

from crkr.client.cli import progress as module
from crkr.client.cli.progress import counting


def test_without_a_terminal_there_is_a_plain_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with counting("importing", 10) as show:
        for done in range(10):
            show(done)
    assert capsys.readouterr().err == ""  # it was soon over
    monkeypatch.setattr(module, "_EVERY_S", 0.0)
    with counting("importing", 10) as show:
        show(4)
        show(10)
    assert capsys.readouterr() == ("", "importing: 4 of 10\nimporting: 10 of 10\n")
