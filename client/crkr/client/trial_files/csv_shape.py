"""Checks that a CSV file is complete before any row is stored: all columns in every row, all quotes closed.

pyarrow's reader silently drops the rows after a quote that is never closed.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Final, TextIO
from uuid import UUID

from crkr.client.trial_files.layout import Layout
from crkr.protocol import Invalid

__all__ = ["LONGEST_LINE", "csv_shape"]

LONGEST_LINE: Final = 2**20  # characters; also of a cell with line breaks in it


def csv_shape(path: Path, layout: Layout) -> tuple[list[str], int]:
    """The column names and the number of rows.

    Raises:
        Invalid: Columns of other names, a row with more or fewer of them, or a quote that is never closed; the message
            names the row.
    """
    # Columns that are not read may be in any encoding; pyarrow checks the others.
    with path.open(newline="", encoding="utf-8-sig", errors="surrogateescape") as file:
        records = csv.reader(_lines(file), strict=True)
        try:
            names = next(records, [])
        except csv.Error as error:
            raise Invalid(f"it cannot be read: {error}") from error
        layout.check(names)
        count = 0
        usual = csv.field_size_limit(LONGEST_LINE)
        try:
            for record in records:
                if record:  # an empty line is no row
                    count += 1
                    _check_record(count, record, names)
        except csv.Error as error:
            ended = "unexpected end" in str(error)
            why = "a quote is opened here and never closed" if ended else str(error)
            raise Invalid(f"row {count + 1}: {why}", details={"row": count + 1}) from error
        finally:
            csv.field_size_limit(usual)
    return names, count


def _lines(file: TextIO) -> Iterator[str]:
    number = 0
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) == LONGEST_LINE and line[-1] not in "\r\n":
            raise Invalid(f"line {number} has more than {LONGEST_LINE} characters")
        yield line


def _check_record(number: int, record: list[str], names: list[str]) -> None:
    if len(record) != len(names):
        raise Invalid(f"row {number}: Expected {len(names)} columns, got {len(record)}", details={"row": number})
    for name, cell in zip(names, record, strict=True):
        if "\n" in cell and any(_is_row(line, names) for line in cell.split("\n")[1:]):
            raise Invalid(
                f"row {number}, column {name!r}: whole rows are between quotes; is one opened here and not closed?",
                details={"row": number},
            )


def _is_row(line: str, names: list[str]) -> bool:
    """Whether a line of a cell looks like a row of the file, taken in by an unclosed quote."""
    cells = next(csv.reader([line]), [])
    if len(cells) != len(names):
        return False
    try:
        UUID(cells[names.index("id")])
    except ValueError:
        return False
    return True
