"""Files of trials by their names' endings."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final, Protocol, final
from uuid import uuid4

from crkr.client.cli.error_lines import require
from crkr.client.trial_files.layout import FileRow, Layout
from crkr.protocol import Invalid, StorageError

__all__ = ["Sink", "Source", "check_free", "check_kind", "reading", "writing"]

_KINDS: Final = (".parquet", ".csv", ".npz")


class Sink(Protocol):
    """A file that trials are written to."""

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Takes values by column."""
        ...

    def close(self) -> None:
        """Writes what is left."""
        ...


@final
@dataclass(frozen=True, slots=True)
class Source:
    """A file that trials are read from.

    Attributes:
        count: How many there are.
        rows: Each of them; raises `Invalid` at the first that no trial of the task can be.
    """

    count: int
    rows: Iterator[FileRow]


def check_kind(path: Path) -> str:
    """The ending of the file's name, which says what it is.

    Raises:
        Invalid: None of those that are known.
        ModuleNotFoundError: The library for this one is not installed.
    """
    kind = path.suffix.lower()
    if kind not in _KINDS:
        raise Invalid(f"the file's name must end in {', '.join(_KINDS)}; got {path.name!r}")
    if kind != ".npz":
        require("pyarrow")
    return kind


def check_free(path: Path, *, overwrite: bool) -> None:
    """Looks whether a file may be written.

    Raises:
        Invalid: There is one already, and it is not to be overwritten; or something that is no file.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise Invalid(f"{path} exists; choose another file, or --overwrite")
    if path.exists() and not path.is_file():
        raise Invalid(f"{path} is no regular file; choose another name")


@contextmanager
def writing(path: Path, layout: Layout, *, overwrite: bool = False) -> Iterator[Sink]:
    """A new file, or one in place of the one there; it appears under its name when it is whole.

    Raises:
        Invalid: There is one already, and it is not to be overwritten.
    """
    kind = check_kind(path)
    check_free(path, overwrite=overwrite)
    partial = path.with_name(f".crkr-{uuid4().hex}.partial")
    try:
        with partial.open("xb") as file:
            with closing(_sink(file, layout, kind)) as sink:
                yield sink
            file.flush()
            os.fsync(file.fileno())
        check_free(path, overwrite=overwrite)  # it may have come meanwhile
        partial.replace(path)
    except OSError as error:
        if error.filename == str(partial):
            error.filename = str(path)  # which the user knows
        raise
    finally:
        partial.unlink(missing_ok=True)


def reading(path: Path, layout: Layout) -> Source:
    """Opens a file; every complaint about it names it.

    Raises:
        Invalid: It is not what its name says, or lacks columns.
    """
    kind = check_kind(path)
    with _naming(path):
        if path.exists() and not path.is_file():
            raise Invalid("it is no regular file")
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
