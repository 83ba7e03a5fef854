"""Text from other programs, made safe for terminals and logs: control characters are escaped.

A name from another program may contain escape sequences that write the clipboard or clear the screen, line feeds that
forge log lines, and marks that reverse the text after them.
"""

from __future__ import annotations

import logging
import unicodedata
from types import TracebackType
from typing import Final, final

__all__ = ["LogFormatter", "printable"]

_SHORT: Final = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}


def printable(text: str, keep: str = "") -> str:
    r"""The text, with everything but visible characters and spaces escaped, as in ``\x1b``.

    Escaped are control characters (C0, DEL, C1), direction marks, zero-width characters, line and paragraph separators,
    lone surrogates, and code points that Unicode does not assign.

    Args:
        text: Any.
        keep: Characters that are not escaped, such as a line feed.
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() or one in keep else _written(one) for one in text)


def _written(one: str) -> str:
    """One character that Python calls unprintable; spaces among them are harmless."""
    if unicodedata.category(one) == "Zs":
        return one
    code = ord(one)
    return _SHORT.get(one) or (
        f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
    )


@final
class LogFormatter(logging.Formatter):
    """One line for each record, whatever it quotes; traceback lines are indented, so that none looks like a record."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # its name in logging
        """The record's line."""
        return printable(super().formatMessage(record))

    def formatException(  # noqa: N802  # its name in logging
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None],
    ) -> str:
        """The traceback."""
        return _indented(super().formatException(ei))

    def formatStack(self, stack_info: str) -> str:  # noqa: N802  # its name in logging
        """The stack."""
        return _indented(super().formatStack(stack_info))


def _indented(lines: str) -> str:
    return "\n".join(f"  {printable(line)}" for line in lines.split("\n"))
