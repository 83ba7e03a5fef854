"""Whether the code on disk still is the code that runs: a process that the server starts later would run the other.

An upgrade of the package replaces its files under a running server, and a removed environment takes them away.
"""

from __future__ import annotations

import sys
from hashlib import blake2b
from pathlib import Path
from typing import Final, final

__all__ = ["InstalledCode"]

# What a started process shares with the server: our own modules, and the versions of the libraries that compute.
_OURS: Final = ("crkr.protocol", "crkr.learner", "crkr.server")
_LIBRARIES: Final = ("numpy.version", "scipy.version")


@final
class InstalledCode:
    """The files of the modules that are loaded now."""

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
        """Whether one of them holds something else now, or is gone."""
        return self._read() != self._digest

    def _read(self) -> bytes:
        """A digest of them all; of nothing where one cannot be read."""
        digest = blake2b()
        try:
            for file in self._files:
                digest.update(file.read_bytes())
        except OSError:
            return b""
        return digest.digest()
