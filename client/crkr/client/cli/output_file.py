"""Files that a command is told to write: none is replaced unasked, and a failed run leaves it as it was."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from crkr.protocol import Invalid

__all__ = ["beside", "check_output", "output_file"]


def check_output(path: Path, *, overwrite: bool) -> None:
    """Looks before the work whether a file can be written, and whether it may.

    Args:
        path: The file.
        overwrite: Whether one that is there may be replaced.

    Raises:
        Invalid: There is such a file and nobody said `--overwrite`, it is no ordinary file, there is no such folder, or
            this process may not write there.
    """
    target = _target(path)
    if target.exists() and not target.is_file():
        raise Invalid(f"{path} is not an ordinary file; choose another file")
    if os.path.lexists(path) and not overwrite:
        raise Invalid(f"{path} exists; choose another file, or --overwrite")
    folder = target.parent
    if not folder.is_dir():
        raise Invalid(f"there is no folder {path.parent}; make it first")
    if not os.access(folder, os.W_OK | os.X_OK) or (target.exists() and not os.access(target, os.W_OK)):
        raise Invalid(f"{path} cannot be written: permission denied; choose another file")


def beside(path: Path) -> Path:
    """A new name with the same ending in the same folder, as `run.1f2e3d4c.partial.rrd`."""
    target = _target(path)
    return target.with_name(f"{target.stem}.{uuid4().hex[:8]}.partial{target.suffix}")


@contextmanager
def output_file(path: Path) -> Iterator[Path]:
    """Gives a name to write to; what was written appears under `path` when it is whole, and is removed if it is not."""
    partial = beside(path)
    try:
        yield partial
        partial.replace(_target(path))
    finally:
        partial.unlink(missing_ok=True)


def _target(path: Path) -> Path:
    """The file that a link leads to: the link stays."""
    return Path(os.path.realpath(path))
