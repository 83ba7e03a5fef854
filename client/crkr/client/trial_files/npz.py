"""Trials in NumPy's npz: coordinates as matrices (n, d), (n, p) and (n, q), everything else as one array a column.

No pickle: text is an array of text, and `info` is UTF-8 bytes, a line of JSON for each trial and an empty one for none.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any, Final, final

import numpy as np
from numpy.typing import NDArray

from crkr.client.trial_files.layout import Layout
from crkr.protocol import Invalid

__all__ = ["NpzSink", "npz_source"]

# How a column's gaps are written.
_GAPS: Final[Mapping[str, Any]] = {"int": -1, "float": np.nan, "text": "", "flag": False}
_DTYPES: Final[Mapping[str, Any]] = {"int": np.int64, "float": np.float64, "text": np.str_, "flag": np.bool_}


@final
class NpzSink:
    """Keeps all trials until `close` writes them."""

    def __init__(self, file: IO[bytes], layout: Layout) -> None:
        self._file, self._layout = file, layout
        self._columns: dict[str, list[Any]] = {name: [] for name in layout.types}

    def write(self, columns: Mapping[str, Sequence[Any]]) -> None:
        """Takes values by column."""
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
        for name, kind in layout.types.items():
            if "." not in name and name != "info":
                arrays[name] = _array(columns[name], kind)
        lines = "".join(f"{text or ''}\n" for text in columns["info"])
        arrays["info"] = np.frombuffer(lines.encode(), np.uint8)
        np.savez(self._file, allow_pickle=False, **arrays)


def npz_source(path: Path, layout: Layout) -> tuple[int, Iterator[Mapping[str, Any]]]:
    """How many rows there are, and each by column.

    Raises:
        Invalid: Not npz, arrays of other shapes, or of coordinates that the task has not.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files}
    except (ValueError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise Invalid(f"it is not npz: {error}") from error
    columns = {name: arrays[name] for name in layout.types if name in arrays and name != "info"}
    for group, names in _groups(layout).items():
        columns |= _split(group, names, arrays)
    layout.check(columns)
    count = len(columns["id"]) if columns["id"].ndim == 1 else -1
    given = {name: arrays[name] for name in ("outcome_given",) if name in arrays}
    odd = [f"{name} {column.shape}" for name, column in (columns | given).items() if column.shape != (count,)]
    if odd:
        raise Invalid(f"every array must have one row for each of the ids; got {', '.join(odd)}")
    infos = _infos(arrays, count)
    return count, _rows(layout, columns, arrays.get("outcome_given"), infos)


def _groups(layout: Layout) -> dict[str, tuple[str, ...]]:
    return {"state": layout.state, "goal": layout.goal, "outcome": layout.outcome}


def _array(values: Sequence[Any], kind: str) -> NDArray[Any]:
    gap = _GAPS[kind]
    return np.array([gap if value is None else value for value in values], dtype=_DTYPES[kind])


def _split(group: str, names: Sequence[str], arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """A matrix's columns by name."""
    matrix = arrays.get(group)
    if matrix is None or (group == "outcome" and matrix.ndim == 2 and not matrix.shape[1]):
        return {}
    if matrix.ndim != 2 or matrix.dtype.kind not in "iuf":
        raise Invalid(f"{group} must be a matrix of numbers; got shape {matrix.shape} of {matrix.dtype}")
    own = [name.partition(".")[2] for name in names]
    given = arrays[f"{group}_names"].tolist() if f"{group}_names" in arrays else own
    if len(given) != matrix.shape[1]:
        raise Invalid(
            f"{group} has {matrix.shape[1]} columns, but the names are: {', '.join(map(str, given)) or 'none'}"
        )
    return {f"{group}.{name}": matrix[:, place] for place, name in enumerate(given)}


def _infos(arrays: Mapping[str, NDArray[Any]], count: int) -> list[str]:
    if "info" not in arrays:
        return [""] * count
    lines = arrays["info"].tobytes().decode(errors="replace").split("\n")[:-1]
    if len(lines) != count:
        raise Invalid(f"info must have one line for each of {count} trials; got {len(lines)}")
    return lines


def _rows(
    layout: Layout, columns: Mapping[str, NDArray[Any]], given: NDArray[Any] | None, infos: Sequence[str]
) -> Iterator[Mapping[str, Any]]:
    for place, info in enumerate(infos):
        row = {name: column[place].item() for name, column in columns.items()}
        for name, kind in layout.types.items():
            if kind in ("int", "text") and row.get(name) == _GAPS[kind]:
                row[name] = None
        if given is not None and not given[place]:
            row |= dict.fromkeys(layout.outcome)
        row["info"] = info
        yield row
