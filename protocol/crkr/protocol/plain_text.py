"""Text from others, made safe for a terminal or a log: control characters are escaped.

A name that another program chose may hold escape sequences that write the clipboard or clear the screen, line feeds
that forge lines of a log, and marks that turn the direction of what follows.
"""

from __future__ import annotations

import logging
import unicodedata
from types import TracebackType
from typing import Final, final

__all__ = ["LogFormatter", "printable"]

_SHORT: Final = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}


def printable(text: str, keep: str = "") -> str:
    r"""The text with everything written as an escape, such as ``\x1b``, that is no visible character and no space.

    That is control characters (C0, DEL, C1), marks of direction and zero width, separators of lines and paragraphs,
    halves of surrogate pairs, and what Unicode does not assign.

    Args:
        text: Any.
        keep: Characters that stay all the same, such as a line feed.
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() or one in keep else _written(one) for one in text)


def _written(one: str) -> str:
    """One character that Python calls unprintable; of those, spaces of any width are harmless."""
    if unicodedata.category(one) == "Zs":
        return one
    code = ord(one)
    return _SHORT.get(one) or (
        f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"
    )


@final
class LogFormatter(logging.Formatter):
    """One line a record, whatever its message quotes; the lines of a traceback are indented, so that none looks new."""

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
