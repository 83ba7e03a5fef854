"""Metadata of a call: which client asks, and how long it waits for this attempt.

It is the query's attachment, so that the message's bytes are the same in every attempt, and optional, so that older
clients and servers do without.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import msgpack

from crkr.protocol.codec import pack
from crkr.protocol.earlier_python import Self

__all__ = ["LONGEST_METADATA", "CallMetadata"]

LONGEST_METADATA: Final = 256  # bytes; a longer attachment is ignored
_LONGEST_MS: Final = 86_400_000  # a day


@final
@dataclass(frozen=True, slots=True)
class CallMetadata:
    """What a server may want to know about a call besides its message.

    Attributes:
        client: 16 bytes shared by all calls of one client; b"" if unknown.
        left_ms: How much longer the client waits [ms]; None if unknown.
    """

    client: bytes = b""
    left_ms: int | None = None

    def to_bytes(self) -> bytes:
        """The attachment's bytes."""
        message: dict[str, object] = {"client": self.client}
        if self.left_ms is not None:
            message["left_ms"] = self.left_ms
        return pack(message)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Reads an attachment; one of another form, perhaps another program's, counts as empty."""
        if len(data) > LONGEST_METADATA:
            return cls()
        try:
            message = msgpack.unpackb(data)
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException):
            return cls()
        if not isinstance(message, dict):
            return cls()
        client, left_ms = message.get("client"), message.get("left_ms")
        return cls(
            client if isinstance(client, bytes) and len(client) == 16 else b"",
            left_ms if type(left_ms) is int and 0 <= left_ms <= _LONGEST_MS else None,
        )
