"""Trials in Parquet and CSV; the only module that imports pyarrow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final, final

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from crkr.client.trial_files.csv_shape import LONGEST_LINE, csv_shape
from crkr.client.trial_files.layout import Layout
from crkr.protocol import Invalid

__all__ = ["ArrowSink", "csv_source", "parquet_source"]

_TYPES: Final = {"int": pa.int64(), "float": pa.float64(), "text": pa.string(), "flag": pa.bool_()}
_ROWS: Final = 4096  # read together
_BUFFER: Final = 2**20  # bytes of each column in a Parquet file
_MANY_BYTES: Final = 2**28  # of one group of rows; larger files may have more
_MOST_PACKED: Final = 100  # times the file's own size
_PLACE: Final = re.compile(r"(?:In CSV column #(\d+): )?(?:.*?)Row #(\d+): (.*)", re.DOTALL)


@final
class ArrowSink:
    """Writes each batch at once, so that a long task needs no memory."""

    def __init__(self, file: IO[bytes], layout: Layout, kind: str) -> None:
        self._schema = pa.schema([(name, _TYPES[type_]) for name, type_ in layout.types.items()])
        self._writer: Any
        if kind == ".parquet":
            self._writer = pa.parquet.ParquetWriter(file, self._schema, write_page_checksum=True)
        else:
            self._writer = pa.csv.CSVWriter(file, self._schema)

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Adds rows, given as values by column."""
        self._writer.write_table(pa.table(dict(columns), schema=self._schema))

    def close(self) -> None:
        """Writes the rest."""
        self._writer.close()


def parquet_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """The number of rows, and the rows, each by column.

    Raises:
        Invalid: Not Parquet, columns of other names or types, or sizes that no file of trials has.
    """
    with _content_errors():
        file = pa.parquet.ParquetFile(path, pre_buffer=False, buffer_size=_BUFFER, page_checksum_verification=True)
        schema, count = file.schema_arrow, int(file.metadata.num_rows)
    layout.check(schema.names)
    known = [name for name in layout.read if name in schema.names]
    with _content_errors():
        for name in known:
            _check_type(name, schema.field(name).type, count)
        _check_sizes(file.metadata, path.stat().st_size)

    def batches() -> Iterator[Any]:
        with file, _content_errors():
            yield from file.iter_batches(_ROWS, columns=known, use_threads=False)

    return count, _rows(batches(), known, layout)


def csv_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """The number of rows, and the rows, each by column.

    Raises:
        Invalid: Not CSV, columns of other names, or a value of another type; the message names row and column.
    """
    names, count = csv_shape(path, layout)
    wanted = [name for name in names if name in layout.read]

    def batches() -> Iterator[Any]:
        with _content_errors(names), _csv_reader(path, wanted) as reader:
            yield from reader

    return count, _rows(batches(), wanted, layout) if count else iter(())


def _csv_reader(path: Path, wanted: Sequence[str]) -> Any:
    return pa.csv.open_csv(
        path,
        # With threads, an error would not name its row. A row must fit in a block.
        read_options=pa.csv.ReadOptions(use_threads=False, block_size=4 * LONGEST_LINE),
        parse_options=pa.csv.ParseOptions(newlines_in_values=True),
        convert_options=pa.csv.ConvertOptions(
            column_types=dict.fromkeys(wanted, pa.string()),
            include_columns=wanted,
            null_values=[""],
            strings_can_be_null=True,
            quoted_strings_can_be_null=False,
        ),
    )


def _check_type(name: str, kind: Any, count: int) -> None:
    """Refuses types that no column has: dates, lists, maps."""
    kind = kind.value_type if pa.types.is_dictionary(kind) else kind
    kind = kind.storage_type if isinstance(kind, pa.BaseExtensionType) else kind
    is_plain = any(
        is_one(kind)
        for is_one in (
            pa.types.is_null,
            pa.types.is_boolean,
            pa.types.is_integer,
            pa.types.is_floating,
            pa.types.is_decimal,
            _is_text,
            pa.types.is_binary,
            pa.types.is_large_binary,
            pa.types.is_fixed_size_binary,
        )
    )
    if count and not is_plain:
        raise Invalid(f"row 1, column {name!r}: a trial has no value of type {kind} there")


def _check_sizes(metadata: Any, there: int) -> None:
    """Compares the sizes in the file's metadata with its real size, before anything is read.

    Not by column: pyarrow aborts the process where the sizes of a damaged file's column contradict each other.
    """
    total = 0
    for place in range(metadata.num_row_groups):
        group = metadata.row_group(place)
        total += group.num_rows
        if not 0 <= group.total_byte_size <= max(_MANY_BYTES, _MOST_PACKED * there):
            raise Invalid(
                f"a group of its rows would have {group.total_byte_size} bytes, but the file has {there}; "
                "write smaller groups"
            )
    if total != metadata.num_rows:
        raise Invalid(f"it should have {metadata.num_rows} rows, but its groups have {total}")


def _rows(batches: Iterator[Any], names: Sequence[str], layout: Layout) -> Iterator[Mapping[str, Any]]:
    number = 0
    for batch in batches:
        with _content_errors():
            cells = [_cells(batch.column(name), layout.read[name] == "float") for name in names]
        for place in range(batch.num_rows):
            number += 1
            yield {
                name: layout.parsed(number, name, column[place]) if is_text else column[place]
                for name, (column, is_text) in zip(names, cells, strict=True)
            }


def _cells(column: Any, are_numbers: bool) -> tuple[list[Any], bool]:
    """The values of a column, and whether they are text to be parsed."""
    if isinstance(column, pa.ExtensionArray):  # e.g. UUIDs, stored as 16 bytes
        column = column.storage
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    if are_numbers and _is_text(kind):
        with suppress(pa.ArrowInvalid):  # gaps or other text: parsed cell by cell
            return column.cast(pa.float64()).to_pylist(), False
    return column.to_pylist(), _is_text(kind)


def _is_text(kind: Any) -> bool:
    return any(is_one(kind) for is_one in (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view))


@contextmanager
def _content_errors(columns: Sequence[str] = ()) -> Iterator[None]:
    """Turns errors about a file's content into `Invalid`.

    Args:
        columns: All columns of the file, as pyarrow counts them; its rows count the header.
    """
    try:
        yield
    except OSError as error:
        if error.errno is not None:  # an error of the disk, not of the content
            raise
        raise Invalid(f"it cannot be read: {error}") from error
    except (pa.ArrowException, ValueError, TypeError, LookupError, OverflowError, RecursionError) as error:
        if isinstance(error, MemoryError):
            raise
        found = _PLACE.match(str(error))
        if found is None:
            raise Invalid(f"it cannot be read: {error}") from error
        column = f", column {columns[int(found[1])]!r}" if found[1] else ""
        raise Invalid(f"row {int(found[2]) - 1}{column}: {found[3]}") from error
