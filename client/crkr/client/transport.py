"""The network as the client sees it. `Client` uses Zenoh unless it is given another transport, such as a test's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from crkr.client.network.presence import Presence
    from crkr.client.network.role import Role
    from crkr.client.network.subscription import Subscription

__all__ = ["Transport"]


class Transport(Protocol):
    """A way to one server; all methods may be called from many threads.

    Deadlines are moments of the monotonic clock [s].
    """

    @property
    def endpoint(self) -> str:
        """Where the server is, for error messages."""

    def query(
        self, key: str, kind: str, payload: bytes, deadline: float, *, patient: bool = False, optional: bool = False
    ) -> bytes:
        """Sends a request, repeats it until it is answered, and returns the answer.

        Args:
            key: Where to.
            kind: Name of the message, e.g. "predict".
            payload: The message; every attempt sends the same bytes.
            deadline: When to give up.
            patient: One attempt may use all the time; for calls whose work may take long.
            optional: Give up at once where nobody serves the key; the caller knows another way.

        Raises:
            Invalid: The message is too large.
            Unavailable: No answer by the deadline; the request may have been executed.
            Unsupported: Nobody serves an optional key.
            CrkrError: The server's typed error.
        """

    def publish(self, key: str, kind: str, payload: bytes) -> None:
        """Publishes a message, which may be lost; never waits."""

    def subscribe(self, task: str, topics: Sequence[str], capacity: int, deadline: float) -> Subscription:
        """Receives a task's publications from now on; raises `Unavailable` where there is no connection."""

    def announce(self, task: str, worker_id: str, deadline: float) -> Presence:
        """Shows a worker as alive until the returned object is closed.

        Raises:
            Invalid: An id that cannot stand in a key.
            Conflict: A living worker has that id.
            Unavailable: No connection by the deadline.
        """

    def take_role(self, task: str, role: str, deadline: float) -> Role | None:
        """Takes a role that one process at a time has in a task; None where another process has it.

        Raises:
            Invalid: A name that cannot stand in a key.
            Unavailable: No connection by the deadline.
        """

    def close(self) -> None:
        """Ends the connection; calls in progress raise `Unavailable`."""
