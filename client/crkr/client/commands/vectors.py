"""Numbers that people type: "0.1 0.2, -3e-1"."""

from __future__ import annotations

import re

import typer

__all__ = ["parse_ids", "parse_vector"]

from uuid import UUID


def parse_vector(text: str, option: str) -> list[float]:
    """Numbers separated by blanks or commas; "nan" is allowed. Raises a usage error that names the option."""
    words = re.split(r"[\s,]+", text.strip())
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise typer.BadParameter(f'{option} takes numbers in quotes, as in {option} "0.1 0.2"; got {text!r}') from error


def parse_ids(texts: list[str]) -> list[UUID]:
    """UUIDs as text; raises a usage error for what is none."""
    ids = []
    for text in texts:
        try:
            ids.append(UUID(text))
        except ValueError as error:
            raise typer.BadParameter(f"an id is a UUID, as `crkr explain` prints it; got {text!r}") from error
    return ids
