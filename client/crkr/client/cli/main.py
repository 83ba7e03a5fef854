"""The entry point of the `crkr` command."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress
from traceback import format_exception
from types import TracebackType
from typing import Final

__all__ = ["main"]

# BLAS threads do not pay for small matrices, and those of several workers compete for the cores.
# The variables are read when numpy is imported, so they are set before any other import of crkr.
_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main() -> None:
    """Runs `crkr` with the process's arguments."""
    for name in _THREADS:
        if not _is_count(os.environ.get(name, "")):
            os.environ[name] = "1"
    sys.excepthook = _tell_defect  # before Typer reads it
    threading.excepthook = _tell_defect_of_a_thread
    from crkr.client.cli.standard_streams import READER_GONE, discard_output, flushed, open_streams
    from crkr.client.cli.subcommands import build

    open_streams()
    try:
        build(sys.argv[1:])(prog_name="crkr")
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.__context__, BrokenPipeError):  # Typer and Rich make it 1
            status = READER_GONE
    except OSError as error:  # of help and version, which are printed outside every command
        sys.stderr.write(f"error: standard output cannot be written: {error.strerror}\n")
        discard_output()
        status = 1
    status = flushed(status)
    _exit_despite_threads(status)
    sys.exit(status)


def _tell_defect(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Prints a traceback with control characters escaped, since it may quote what others sent."""
    if issubclass(kind, KeyboardInterrupt):  # while a command was being loaded
        sys.stderr.write("interrupted\n")
        return
    from crkr.protocol import printable

    sys.stderr.write(printable("".join(format_exception(kind, error, trace)), keep="\n"))


def _tell_defect_of_a_thread(ended: threading.ExceptHookArgs) -> None:
    if ended.exc_value is not None and not isinstance(ended.exc_value, SystemExit):
        sys.stderr.write(f"Exception in thread {ended.thread.name if ended.thread else '?'}:\n")
        _tell_defect(ended.exc_type, ended.exc_value, ended.exc_traceback)


def _is_count(value: str) -> bool:
    """Whether a variable is a thread count, or one per level; OpenMP complains about anything else."""
    return all(part.strip().isdecimal() and int(part) > 0 for part in value.split(","))


def _exit_despite_threads(status: int) -> None:
    """Ends the process if a thread of a user's skill would keep it running; our threads are daemons or have ended."""
    if all(thread.daemon for thread in threading.enumerate() if thread is not threading.main_thread()):
        return
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)
