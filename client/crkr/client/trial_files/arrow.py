"""Trials in Parquet and CSV, by pyarrow, which this module alone knows."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final, final

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from crkr.client.trial_files.layout import Layout
from crkr.protocol import Invalid

__all__ = ["ArrowSink", "csv_source", "parquet_source"]

_TYPES: Final = {"int": pa.int64(), "float": pa.float64(), "text": pa.string(), "flag": pa.bool_()}
_ROWS: Final = 4096  # read together
_PLACE: Final = re.compile(r"(?:In CSV column #(\d+): )?(?:.*?)Row #(\d+): (.*)", re.DOTALL)


@final
class ArrowSink:
    """Writes as it is told, so that a long task needs no memory.

    Args:
        file: Where to.
        layout: The columns.
        kind: ".parquet" or ".csv".
    """

    def __init__(self, file: IO[bytes], layout: Layout, kind: str) -> None:
        self._schema = pa.schema([(name, _TYPES[type_]) for name, type_ in layout.types.items()])
        make = pa.parquet.ParquetWriter if kind == ".parquet" else pa.csv.CSVWriter
        self._writer: Any = make(file, self._schema)

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Takes values by column."""
        self._writer.write_table(pa.table(dict(columns), schema=self._schema))

    def close(self) -> None:
        """Writes what is left."""
        self._writer.close()


def parquet_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """How many rows there are, and each by column.

    Raises:
        Invalid: Not Parquet, or columns of other names or types.
    """
    with _complaints():
        file = pa.parquet.ParquetFile(path)
    names = file.schema_arrow.names
    layout.check(names)
    known = [name for name in layout.types if name in names]
    schema = pa.schema([(name, _TYPES[layout.types[name]]) for name in known])

    def rows() -> Iterator[Mapping[str, Any]]:
        with file, _complaints():
            for batch in file.iter_batches(_ROWS, columns=known):
                yield from pa.Table.from_batches([batch]).select(known).cast(schema).to_pylist()

    return int(file.metadata.num_rows), rows()


def csv_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """How many rows there are, and each by column.

    Raises:
        Invalid: Not CSV, columns of other names, or a value of another type; the message names row and column.
    """
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as file, _complaints():
        names = next(csv.reader(file), [])
    layout.check(names)
    wanted = [name for name in names if name in layout.types]
    # A whole number may be written 3.0: spreadsheets do where a column has gaps.
    types = {name: _TYPES["float" if layout.types[name] == "int" else layout.types[name]] for name in wanted}
    with _complaints(names):
        table = pa.csv.read_csv(
            path,
            read_options=pa.csv.ReadOptions(use_threads=False),  # or it would not tell the row of an error
            parse_options=pa.csv.ParseOptions(newlines_in_values=True),
            convert_options=pa.csv.ConvertOptions(
                column_types=types,
                include_columns=wanted,
                null_values=[""],
                strings_can_be_null=True,
                quoted_strings_can_be_null=False,
            ),
        )
    return table.num_rows, (row for batch in table.to_batches(_ROWS) for row in batch.to_pylist())


@contextmanager
def _complaints(columns: Sequence[str] = ()) -> Iterator[None]:
    """Turns complaints about a file's content into `Invalid`.

    Args:
        columns: All that the file has, which is how pyarrow counts them; its rows count the header.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None:  # of the disk, not of what is in the file
            raise
        raise Invalid(f"it cannot be read: {error}") from error
    except csv.Error as error:
        raise Invalid(f"it cannot be read: {error}") from error
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
        found = _PLACE.match(str(error))
        if found is None:
            raise Invalid(f"it cannot be read: {error}") from error
        column = f", column {columns[int(found[1])]!r}" if found[1] else ""
        raise Invalid(f"row {int(found[2]) - 1}{column}: {found[3]}") from error
