"""Metadata of a call: who asks, and how long the asker waits for this attempt.

It travels as the query's attachment, beside the message, so that the message's bytes are the same in every attempt. It
is optional: a server that does not know it, and a client that does not send it, understand each other as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import msgpack

from crkr.protocol.codec import pack
from crkr.protocol.earlier_python import Self

__all__ = ["LONGEST_METADATA", "CallMetadata"]

LONGEST_METADATA: Final = 256  # bytes; a longer attachment is not looked at
_LONGEST_MS: Final = 86_400_000  # a day


@final
@dataclass(frozen=True, slots=True)
class CallMetadata:
    """What a server may want to know of a call besides its message.

    Attributes:
        client: 16 bytes that the calls of one client share, b"" where it does not say.
        left_ms: For how long the asker waits from now on [ms], None where it does not say.
    """

    client: bytes = b""
    left_ms: int | None = None

    def to_bytes(self) -> bytes:
        """As an attachment."""
        message: dict[str, object] = {"client": self.client}
        if self.left_ms is not None:
            message["left_ms"] = self.left_ms
        return pack(message)

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Reads an attachment; one of another form says nothing, for it may be another program's."""
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
