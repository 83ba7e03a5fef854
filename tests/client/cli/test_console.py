"""What commands print, where, and how it looks without a terminal."""

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from uuid import UUID

import numpy as np
import pytest
import typer

from crkr.client.cli.console import configure_logging, print_json, print_table, stderr, stdout, tidy


@pytest.fixture
def root_logger() -> Iterator[logging.Logger]:
    logger = logging.getLogger()
    before = logger.handlers[:], logger.level
    yield logger
    logger.handlers[:], level = before
    logger.setLevel(level)


@dataclass(frozen=True)
class Value:
    numbers: tuple[int, ...]


def test_json_is_one_line_of_plain_data(capsys: pytest.CaptureFixture[str]) -> None:
    identifier = UUID(int=3)
    print_json(
        {
            "array": np.array([[1.5, np.nan], [np.inf, -2.0]]),
            "scalar": np.int64(4),
            "id": identifier,
            "bytes": b"\x01\xff",
            "value": Value((1, 2)),
            1: "long " * 100,
        }
    )
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    assert json.loads(printed) == {
        "array": [[1.5, None], [None, -2.0]],
        "scalar": 4,
        "id": str(identifier),
        "bytes": "01ff",
        "value": {"numbers": [1, 2]},
        "1": "long " * 100,
    }


def test_a_table_without_a_terminal_is_aligned_plain_lines(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("name", "value"), [("a", 1), ("long name", "[bold]x[/]" * 20)], title="things")
    assert capsys.readouterr().out.splitlines() == [
        "things",
        "name       value",
        "a          1",
        "long name  " + "[bold]x[/]" * 20,
    ]


def test_text_is_printed_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    stdout.print("[red]100 :smile:[/red] " + "x" * 200)
    stderr.print("to the other side")
    captured = capsys.readouterr()
    assert captured.out == "[red]100 :smile:[/red] " + "x" * 200 + "\n"
    assert captured.err == "to the other side\n"


def test_log_records_go_to_standard_error(root_logger: logging.Logger, capsys: pytest.CaptureFixture[str]) -> None:
    configure_logging("Warning")
    logging.getLogger("crkr.test").info("unheard")
    logging.getLogger("crkr.test").warning("heard")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "WARNING crkr.test: heard" in captured.err
    assert "unheard" not in captured.err


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "yes"),
        (False, "no"),
        (None, "none"),
        (0.123456789, "0.1235"),
        (250, "250"),
        ("odds", "odds"),
        (np.array([1 / 3, 2.0]), "0.3333 2"),
        (UUID(int=3), str(UUID(int=3))),
    ],
)
def test_a_value_for_people_is_no_repr(value: object, text: str) -> None:
    assert tidy(value) == text


def test_an_unknown_log_level_is_wrong_usage() -> None:
    with pytest.raises(typer.BadParameter, match="debug, info"):
        configure_logging("loud")
