"""The entry of the `crkr` command: sets the process up, then hands over."""

from __future__ import annotations

import io
import os
import sys
from typing import Final

__all__ = ["main"]

# Small matrices on few cores: BLAS threads cost more than they give, and workers beside each other would fight.
# They are read when numpy is imported, so this comes before any other import of crkr.
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Runs `crkr` with the process's arguments."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")
    for stream in (sys.stdout, sys.stderr):  # a name that the locale cannot print must not end a command
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    from crkr.client.frame import build

    build(sys.argv[1:])(prog_name="crkr")
