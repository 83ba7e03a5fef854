"""Files that a command reads or writes; only --overwrite replaces one, and a failed run changes none."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final
from uuid import uuid4

from crkr.protocol import Invalid

__all__ = ["beside", "check_input", "check_output", "output_file"]

_FULL: Final = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)


def check_input(path: Path) -> None:
    """Raises `Invalid` for a pipe, a device or a folder, whose content might never end."""
    if path.exists() and not path.is_file():
        raise Invalid(f"{path} is not an ordinary file; choose another file")


def check_output(path: Path, *, overwrite: bool) -> None:
    """Checks, before the work is done, whether a file can and may be written.

    Raises:
        Invalid: The file exists and may not be replaced, it is not an ordinary file, its folder does not exist, or this
            process may not write there.
    """
    target = _target(path)
    check_input(path)
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
def output_file(path: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Gives a temporary name to write to, and renames that file to `path` when the block ends without an error.

    Args:
        path: The file.
        overwrite: Whether a file of that name may be replaced, also one that appears while the block runs.

    Raises:
        Invalid: As `check_output`, before and after the block.
        OSError: The file cannot be written; the error names `path`.
    """
    check_output(path, overwrite=overwrite)
    partial = beside(path)
    try:
        yield partial
        check_output(path, overwrite=overwrite)
        partial.replace(_target(path))
    except OSError as error:
        if error.filename == str(partial) or (error.filename is None and error.errno in _FULL):
            error.filename = str(path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def _target(path: Path) -> Path:
    """The target of a symbolic link, so that the link stays."""
    return Path(os.path.realpath(path))
