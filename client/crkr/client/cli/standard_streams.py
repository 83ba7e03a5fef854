"""Standard streams that the caller may have closed, or whose reader may close them.

Separate from `console`, because `main` uses it before rich is imported.
"""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Final

__all__ = ["READER_GONE", "discard_output", "flushed", "open_streams"]

READER_GONE: Final = 141  # exit status of a process that SIGPIPE ends


def open_streams() -> None:
    """Opens closed streams to nowhere; otherwise the next file or socket would take their number and get the output."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115  # stays open to the end
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # characters that the locale lacks must not end a command


def discard_output() -> None:
    """Redirects standard output to nowhere, so that flushing it at exit does not fail."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def flushed(status: int) -> int:
    """Flushes standard output; returns `status`, or another exit status where the output cannot be written."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        discard_output()
        return READER_GONE
    except OSError as error:
        discard_output()
        if not status:
            with suppress(OSError):
                sys.stderr.write(f"error: standard output cannot be written: {error.strerror}\n")
            return 1
    return status
