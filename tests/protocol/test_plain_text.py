"""Text from others is printed as what it is, and nothing of it acts on a terminal or a log."""

import io
import logging
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crkr.protocol import LogFormatter, error_from_wire, printable

ANY = st.text(st.characters(exclude_categories=()))  # halves of surrogate pairs too


@given(ANY)
def test_what_is_left_is_visible_or_a_space(text: str) -> None:
    shown = printable(text)
    assert {unicodedata.category(one) for one in shown} & {"Cc", "Cf", "Cs", "Zl", "Zp"} == set()
    shown.encode()  # has no halves of surrogate pairs
    assert printable(shown) == shown


@given(st.text(st.characters(exclude_categories=["C", "Zl", "Zp"])))
def test_words_of_all_languages_stay_as_they_are(text: str) -> None:
    assert printable(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]52;c;eA==\x1b\\", "\\x1b]52;c;eA==\\x1b\\"),
        ("a\nb\rc\td\x00", "a\\nb\\rc\\td\\x00"),
        ("\x7f\x9b31m", "\\x7f\\x9b31m"),
        ("\u202egnp.exe\u2066", "\\u202egnp.exe\\u2066"),
        ("\u200b\u2028\u2029\ufeff", "\\u200b\\u2028\\u2029\\ufeff"),
        ("\udc80\U000e0041", "\\udc80\\U000e0041"),
        ("Schüssel 球 🙂\u00a0x", "Schüssel 球 🙂\u00a0x"),
    ],
)
def test_each_is_written_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


def test_a_line_feed_stays_where_it_is_asked_for() -> None:
    assert printable("a\nb\x1b", keep="\n") == "a\nb\\x1b"


def test_a_record_of_a_log_is_one_line_and_its_traceback_cannot_look_like_another() -> None:
    told = io.StringIO()
    handler = logging.StreamHandler(told)
    handler.setFormatter(LogFormatter("%(levelname)s %(message)s"))
    logger = logging.Logger("crkr.test")
    logger.addHandler(handler)
    logger.info("worker %s", "x\x1b[2J\nERROR all is lost")
    try:
        raise ValueError("one\nERROR two\x1b")
    except ValueError:
        logger.exception("failed", stack_info=True)
    lines = told.getvalue().splitlines()
    assert lines[0] == "INFO worker x\\x1b[2J\\nERROR all is lost"
    assert [line for line in lines if not line.startswith("  ")][1:] == ["ERROR failed"]
    assert "  ERROR two\\x1b" in lines


def test_the_message_of_an_answered_error_holds_no_control_characters() -> None:
    for code in ("INVALID", "\x1b[2J"):
        error = error_from_wire({"code": code, "message": "no\x1b[2J\n"})
        assert error.message.isprintable()
        assert str(error).isprintable()
