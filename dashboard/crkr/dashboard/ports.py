"""Loopback ports: the wanted one, or the next that is free."""

from __future__ import annotations

import socket
from typing import Final

from crkr.protocol import Invalid

__all__ = ["choose_port"]

TRIED: Final = 100


def choose_port(host: str, given: int | None, default: int) -> int:
    """A port that can be listened on.

    Args:
        host: Address to listen on.
        given: The one that was asked for, or None.
        default: Where to start looking when none was.

    Raises:
        Invalid: The given port is taken, or a hundred in a row are.
    """
    if given is not None:
        if not _is_free(host, given):
            raise Invalid(f"port {given} on {host} is taken; choose another, or none and a free one is found")
        return given
    for port in range(default, default + TRIED):
        if _is_free(host, port):
            return port
    raise Invalid(f"no free port from {default} to {default + TRIED - 1} on {host}")


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        # As servers do: a connection of an earlier run that still lingers is no hindrance.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True
