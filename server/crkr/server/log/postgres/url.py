"""URLs of databases, without psycopg, so that any command can tell a database from a data directory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

__all__ = ["is_url", "printable_location"]

_URL: Final = re.compile(r"postgres(?:ql)?://")
_PARAMETER: Final = re.compile(r"(password=)[^&]*")
_PASSWORD: Final = re.compile(r"(://[^/@:]*):.*@", re.DOTALL)  # may contain / and @, and ends at the last @


def is_url(where: str | Path) -> bool:
    """Whether a log is a PostgreSQL database."""
    return _URL.match(str(where)) is not None


def printable_location(where: str | Path) -> str:
    """A location without its password."""
    return _PASSWORD.sub(r"\1@", _PARAMETER.sub(r"\1...", str(where)))
