"""The entry of the `crkr` command: sets the process up, then hands over."""

from __future__ import annotations

import io
import os
import sys
import threading
from contextlib import suppress
from typing import Final

__all__ = ["main"]

# Small matrices on few cores: BLAS threads cost more than they give, and workers beside each other would fight.
# They are read when numpy is imported, so this comes before any other import of crkr.
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Runs `crkr` with the process's arguments."""
    for name in _THREADS:
        if not _is_count(os.environ.get(name, "")):
            os.environ[name] = "1"
    if isinstance(sys.stdout, io.TextIOWrapper):  # bars and dashes are no reason to fail where the locale has none
        sys.stdout.reconfigure(errors="replace")
    from crkr.client.frame import build

    try:
        build(sys.argv[1:])(prog_name="crkr")
    except SystemExit as end:
        _leave_strangers_behind(end.code)
        raise


def _is_count(value: str) -> bool:
    """Whether a variable says how many threads, or how many at each level: OpenMP complains of all else."""
    return all(part.strip().isdecimal() and int(part) > 0 for part in value.split(","))


def _leave_strangers_behind(code: object) -> None:
    """Ends the process where a thread of a user's skill would keep it for ever: ours are daemons, or have ended."""
    if all(thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        return
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code if isinstance(code, int) else 0 if code is None else 1)
