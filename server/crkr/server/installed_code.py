"""Detects whether the code on disk is still the running code, which a new process would not share.

An upgrade replaces the files of a running server, and removing its environment deletes them.
"""

from __future__ import annotations

import errno
import sys
from hashlib import blake2b
from pathlib import Path
from typing import Final, final

__all__ = ["InstalledCode"]

# Must be the same in both processes: our modules, and the versions of numerical libraries.
_OURS: Final = ("crkr.protocol", "crkr.learner", "crkr.server")
_LIBRARIES: Final = ("numpy.version", "scipy.version")


@final
class InstalledCode:
    """The files of the loaded modules."""

    def __init__(self) -> None:
        loaded = {
            str(module.__file__)
            for name, module in list(sys.modules.items())
            if (name in _LIBRARIES or name.startswith(_OURS)) and getattr(module, "__file__", None)
        }
        self._files = [Path(file) for file in sorted(loaded)]
        self._digest = self._read()

    @property
    def is_replaced(self) -> bool:
        """Whether a file has changed or is gone."""
        try:
            return self._read() != self._digest
        except OSError:
            return False

    def _read(self) -> bytes:
        """A digest of all files; empty if one cannot be read. Raises `OSError` if the process may open no file."""
        digest = blake2b()
        try:
            for file in self._files:
                digest.update(file.read_bytes())
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE):
                raise
            return b""
        return digest.digest()
