"""Trials in NumPy's npz: coordinates as matrices (n, d), (n, p) and (n, q), everything else as one array a column.

No pickle: text is an array of text, and `info` is UTF-8 bytes, a line of JSON for each trial and an empty one for none.
Arrays are read a few rows at a time, after their headers are compared with the archive's sizes, and only arrays that
belong to trials.
"""

from __future__ import annotations

import errno
import math
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.client.trial_files.layout import Layout
from crkr.protocol import CrkrError, Invalid
from crkr.protocol.checks import flag, shown

__all__ = ["NpzSink", "npz_source"]

# How a column's gaps are written.
_GAPS: Final[Mapping[str, Any]] = {"int": -1, "float": np.nan, "text": "", "flag": False}
_DTYPES: Final[Mapping[str, Any]] = {"int": np.int64, "float": np.float64, "text": np.str_, "flag": np.bool_}
_GIVEN: Final = ("outcome_given", "worker_given")  # tell a gap from an outcome of only NaN, and from an empty name
_ROWS: Final = 4096  # read together
_LONGEST_LINE: Final = 2**20  # bytes of a trial's info
_WIDEST: Final = 2**16  # bytes of a row of one array
_MOST_WHOLE: Final = 2**28  # bytes of an array in column order, which is read at once


@final
class NpzSink:
    """Keeps all trials until `close` writes them."""

    def __init__(self, file: IO[bytes], layout: Layout) -> None:
        self._file, self._layout = file, layout
        self._columns: dict[str, list[Any]] = {name: [] for name in layout.types}

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Adds rows, given as values by column."""
        for name, values in columns.items():
            self._columns[name] += values

    def close(self) -> None:
        """Writes the file."""
        layout, columns = self._layout, self._columns
        arrays: dict[str, NDArray[Any]] = {}
        for group, names in _groups(layout).items():
            filled = [_array(columns[name], "float") for name in names]
            arrays[group] = np.stack(filled, axis=1) if filled else np.empty((len(columns["id"]), 0))
            arrays[f"{group}_names"] = np.array([name.partition(".")[2] for name in names], dtype=np.str_)
        if layout.outcome:
            arrays["outcome_given"] = np.array([value is not None for value in columns[layout.outcome[0]]], dtype=bool)
        arrays["worker_given"] = np.array([value is not None for value in columns["worker"]], dtype=bool)
        for name, kind in layout.types.items():
            if "." not in name and name != "info":
                arrays[name] = _array(columns[name], kind)
        lines = "".join(f"{text or ''}\n" for text in columns["info"])
        arrays["info"] = np.frombuffer(lines.encode(), np.uint8)
        save: Any = np.savez  # numpy 1 has no allow_pickle; none of these arrays holds objects
        save(self._file, **arrays)


@final
class _Member:
    """An array of an archive, read from its beginning."""

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self.name: Final = name
        entry = archive.getinfo(f"{name}.npy")
        self.stream: Final = archive.open(entry)
        shape, is_fortran, dtype = _header(self.stream)
        self.shape: Final = shape
        self.dtype: Final = dtype
        if dtype.hasobject:
            raise ValueError(f"{name} holds objects, which would need allow_pickle")
        claimed, there = math.prod(shape) * dtype.itemsize, entry.file_size - self.stream.tell()
        if claimed != there:
            raise ValueError(f"{name} should have {claimed} bytes, but there are {there}")
        if dtype.itemsize * math.prod(shape[1:]) > _WIDEST:
            raise ValueError(f"{name} has more than {_WIDEST} bytes a row")
        self._whole: NDArray[Any] | None = None
        self._first = 0
        if is_fortran and len(shape) == 2 and min(shape) > 1:
            if claimed > _MOST_WHOLE:
                raise ValueError(f"{name} is kept by columns and has {claimed} bytes; save it in C order")
            self._whole = self._entries(math.prod(shape)).reshape(shape, order="F")

    def read(self, count: int) -> NDArray[Any]:
        """The next `count` rows."""
        if self._whole is not None:
            self._first += count
            return self._whole[self._first - count : self._first]
        return self._entries(count * math.prod(self.shape[1:])).reshape((count, *self.shape[1:]))

    def _entries(self, count: int) -> NDArray[Any]:
        data = bytearray()
        while left := count * self.dtype.itemsize - len(data):
            piece = self.stream.read(left)
            if not piece:
                raise EOFError(f"{self.name} ends early")
            data += piece
        return np.frombuffer(bytes(data), self.dtype, count) if count else np.empty(0, self.dtype)


def npz_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """The number of rows, and the rows, each by column.

    Raises:
        Invalid: Not npz, arrays of other shapes, or coordinates that the task does not have.
    """
    with _content_errors():
        archive = zipfile.ZipFile(path)
        names = {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}
        asked = [name for name in (*layout.read, *_groups(layout), *_GIVEN) if name in names]
        members = {name: _Member(archive, name) for name in asked if name != "info"}
    columns: dict[str, tuple[int, ...]] = {name: members[name].shape for name in members if name in layout.read}
    places: dict[str, list[str]] = {}  # coordinates by matrix
    for group, own in _groups(layout).items():
        if group in members:
            places[group] = _coordinates(archive, names, members[group], own)
            columns |= {f"{group}.{name}": members[group].shape[:1] for name in places[group]}
    layout.check(columns)
    count = columns["id"][0] if len(columns["id"]) == 1 else -1
    columns |= {name: members[name].shape for name in _GIVEN if name in members}
    if odd := [f"{name} {shape}" for name, shape in columns.items() if shape != (count,)]:
        raise Invalid(f"every array must have one row for each of the ids; got {', '.join(odd)}")
    info = _info(archive, count) if "info" in names else None
    return count, _rows(archive, layout, members, places, info, count)


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in column order, and type."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"an array has format {version}")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about headers of Python 2
        shape, is_fortran, dtype = read(stream)
    if any(size < 0 for size in shape):
        raise ValueError(f"an array has shape {shape}")
    return shape, is_fortran, dtype


def _groups(layout: Layout) -> dict[str, tuple[str, ...]]:
    return {"state": layout.state, "goal": layout.goal, "outcome": layout.outcome}


def _array(values: Sequence[Any], kind: str) -> NDArray[Any]:
    gap = _GAPS[kind]
    return np.array([gap if value is None else value for value in values], dtype=_DTYPES[kind])


def _coordinates(archive: zipfile.ZipFile, names: set[str], matrix: _Member, own: Sequence[str]) -> list[str]:
    """Names of a matrix's columns."""
    group, shape = matrix.name, matrix.shape
    if group == "outcome" and len(shape) == 2 and not shape[1]:
        return []
    if len(shape) != 2 or matrix.dtype.kind not in "iuf":
        raise Invalid(f"{group} must be a matrix of numbers; got shape {shape} of {matrix.dtype}")
    given = [name.partition(".")[2] for name in own]
    if f"{group}_names" in names:
        with _content_errors():
            member = _Member(archive, f"{group}_names")
            if len(member.shape) != 1 or member.shape[0] > _ROWS or member.dtype.kind != "U":
                raise Invalid(f"{group}_names must be a list of text; got shape {member.shape} of {member.dtype}")
            given = member.read(member.shape[0]).tolist()
    if len(given) != shape[1]:
        raise Invalid(f"{group} has {shape[1]} columns, but the names are: {', '.join(given) or 'none'}")
    return given


def _info(archive: zipfile.ZipFile, count: int) -> IO[bytes]:
    """The lines of `info`, one for each trial."""
    with _content_errors():
        member = _Member(archive, "info")
        if len(member.shape) != 1 or member.dtype.itemsize != 1:
            raise Invalid(f"info must be bytes; got shape {member.shape} of {member.dtype}")
        found = 0
        while piece := member.stream.read(_LONGEST_LINE):
            found += piece.count(b"\n")
        if found != count:
            raise Invalid(f"info must have one line for each of {count} trials; got {found}")
        return _Member(archive, "info").stream


def _rows(
    archive: zipfile.ZipFile,
    layout: Layout,
    members: Mapping[str, _Member],
    places: Mapping[str, Sequence[str]],
    info: IO[bytes] | None,
    count: int,
) -> Iterator[Mapping[str, Any]]:
    with archive:
        for first in range(0, count, _ROWS):
            with _content_errors():
                chunk = {name: member.read(min(_ROWS, count - first)).tolist() for name, member in members.items()}
            for place in range(min(_ROWS, count - first)):
                row: dict[str, Any] = {}
                for name, values in chunk.items():
                    if name in places:
                        row |= {f"{name}.{one}": values[place][j] for j, one in enumerate(places[name])}
                    else:
                        row[name] = values[place]
                number = first + place + 1
                worker_given = _given(row, "worker", number, unknown=False)
                for name, kind in layout.read.items():
                    if (
                        kind in ("int", "text")
                        and row.get(name) == _GAPS[kind]
                        and not (name == "worker" and worker_given)
                    ):
                        row[name] = None
                if not _given(row, "outcome", number, unknown=True):
                    row |= dict.fromkeys(layout.outcome)
                row["info"] = _line(info, number) if info is not None else None
                yield row


def _given(row: dict[str, Any], name: str, number: int, *, unknown: bool) -> bool:
    """Whether a row has a value where it looks like a gap; removes the mark."""
    mark = f"{name}_given"
    given = row.pop(mark, unknown)
    try:
        return flag(bool(given) if given in (0, 1) else given, mark)
    except Invalid as error:
        raise Invalid(f"row {number}: {error.message}", details={"row": number}) from error


def _line(info: IO[bytes], number: int) -> str:
    with _content_errors():
        line = info.readline(_LONGEST_LINE)
    if not line.endswith(b"\n"):
        raise Invalid(f"row {number}, column 'info': it has more than {_LONGEST_LINE} bytes")
    try:
        return line[:-1].decode()
    except UnicodeDecodeError as error:
        raise Invalid(f"row {number}, column 'info': it is not UTF-8: {shown(line)}") from error


@contextmanager
def _content_errors() -> Iterator[None]:
    """Turns errors of the readers of zip archives and arrays into `Invalid`."""
    try:
        yield
    except OSError as error:
        if error.errno not in (None, errno.EINVAL):  # an error of the disk, not of the content
            raise
        raise Invalid(f"it is not npz: {error}") from error
    except CrkrError:
        raise
    except Exception as error:  # the header is parsed as Python, so errors of any kind occur
        raise Invalid(f"it is not npz: {error or type(error).__name__}") from error
