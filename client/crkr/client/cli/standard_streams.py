"""Standard input, output and error, which a caller may have closed, or whose reader may leave."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress
from typing import Final

__all__ = ["READER_GONE", "discard_output", "flushed", "open_streams"]

READER_GONE: Final = 141  # exit status of a process that SIGPIPE ends


def open_streams() -> None:
    """Opens what is closed, to nowhere: else the next file or socket would take its place, and get what is printed."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115  # stays open to the end
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a name that the locale lacks must not end a command


def discard_output() -> None:
    """Lets go of standard output, so that the interpreter's end does not stumble over what is still to be written."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def flushed(status: int) -> int:
    """The exit status of a command that wants to end with `status`, once its output is written, or cannot be."""
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
