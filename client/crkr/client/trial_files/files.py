"""Files of trials; the ending of a file's name says its format."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Protocol, final

from crkr.client.cli.error_lines import require
from crkr.client.cli.output_file import check_input, output_file
from crkr.client.trial_files.layout import FileRow, Layout
from crkr.protocol import Invalid, StorageError

__all__ = ["Sink", "Source", "check_kind", "trial_sink", "trial_source"]

_KINDS: Final = (".parquet", ".csv", ".npz")


class Sink(Protocol):
    """Writes trials to a file."""

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Adds rows, given as values by column."""

    def close(self) -> None:
        """Writes the rest."""


@final
@dataclass(frozen=True, slots=True)
class Source:
    """Trials of a file.

    Attributes:
        count: Number of trials.
        rows: The trials; raises `Invalid` at the first row that is not a trial of the task.
    """

    count: int
    rows: Iterator[FileRow]


def check_kind(path: Path) -> str:
    """Returns the ending of the file's name.

    Raises:
        Invalid: The ending is unknown.
        ModuleNotFoundError: The library for this format is not installed.
    """
    kind = path.suffix.lower()
    if kind not in _KINDS:
        raise Invalid(f"the file's name must end in {', '.join(_KINDS)}; got {path.name!r}")
    if kind != ".npz":
        require("pyarrow")
    return kind


@contextmanager
def trial_sink(path: Path, layout: Layout, *, overwrite: bool = False) -> Iterator[Sink]:
    """Gives a sink for trials; the file appears under its name when it is complete.

    Raises:
        Invalid: The file exists and may not be overwritten, or cannot be written.
    """
    kind = check_kind(path)
    with output_file(path, overwrite=overwrite) as partial, partial.open("xb") as file:
        with closing(_sink(file, layout, kind)) as sink:
            yield sink
        file.flush()
        os.fsync(file.fileno())


def trial_source(path: Path, layout: Layout) -> Source:
    """Opens a file; every error names it.

    Raises:
        Invalid: The content is not what the name says, or columns are missing.
    """
    kind = check_kind(path)
    check_input(path)
    with _naming(path):
        count, found = _source(path, layout, kind)

    def rows() -> Iterator[FileRow]:
        number = 0
        with _naming(path):
            for number, values in enumerate(found, 1):
                yield layout.row(number, values)
            if number != count:
                raise Invalid(f"it should have {count} rows, but {number} were read")

    return Source(count, rows())


def _sink(file: IO[bytes], layout: Layout, kind: str) -> Sink:
    if kind == ".npz":
        from crkr.client.trial_files.npz import NpzSink

        return NpzSink(file, layout)
    from crkr.client.trial_files.arrow import ArrowSink

    return ArrowSink(file, layout, kind)


def _source(path: Path, layout: Layout, kind: str) -> tuple[int, Iterator[Mapping[str, Any]]]:
    if kind == ".npz":
        from crkr.client.trial_files.npz import npz_source

        return npz_source(path, layout)
    from crkr.client.trial_files.arrow import csv_source, parquet_source

    return csv_source(path, layout) if kind == ".csv" else parquet_source(path, layout)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    try:
        yield
    except Invalid as error:
        raise Invalid(f"{path}: {error.message}", details=error.details) from error
    except OSError as error:
        if error.filename is not None:
            raise
        raise StorageError(f"{path} cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise Invalid(f"{path}: there is not enough memory to read it") from error
