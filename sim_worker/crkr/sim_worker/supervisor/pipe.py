"""The line between a launcher and one of its processes: small maps over a pipe, and its end when either side dies."""

from __future__ import annotations

from collections.abc import Mapping
from multiprocessing.connection import Connection
from typing import Any, final

from crkr.protocol import pack, unpack

__all__ = ["Line", "LineClosed"]


class LineClosed(Exception):
    """The process at the other end is gone."""


@final
class Line:
    """One end of the line.

    Args:
        connection: One end of `multiprocessing.Pipe()`.
    """

    def __init__(self, connection: Connection) -> None:
        self.connection = connection

    def send(self, message: Mapping[str, Any]) -> None:
        """Sends a message; raises `LineClosed`."""
        try:
            self.connection.send_bytes(pack(message))
        except (BrokenPipeError, ConnectionResetError, OSError) as error:
            raise LineClosed(str(error)) from error

    def receive(self, timeout_s: float) -> dict[str, Any] | None:
        """The next message, or None when none came in time; raises `LineClosed`."""
        try:
            return unpack(self.connection.recv_bytes()) if self.connection.poll(timeout_s) else None
        except (EOFError, BrokenPipeError, ConnectionResetError, OSError) as error:
            raise LineClosed(str(error)) from error

    def close(self) -> None:
        """Lets the other side see the end."""
        self.connection.close()
