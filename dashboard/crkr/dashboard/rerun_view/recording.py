"""The recording in Rerun: a stream that serves viewers and can also be written to a file."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, final

import rerun as rr
import rerun.blueprint as rrb

from crkr.protocol import Unavailable

__all__ = ["APPLICATION", "NameLimit", "Recording"]

_logger = logging.getLogger(__name__)
APPLICATION: Final = "crkr"  # a viewer stores a user's layout under it
FLUSH_EVERY_S: Final = 0.2
LAYOUT_S: Final = 5.0
LISTENS_S: Final = 10.0


@final
class Recording:
    """One run in Rerun; for one thread.

    A slow or stopped viewer never blocks it: it serves viewers and is not a client of one. Only closing can take time,
    which `close` bounds.

    Args:
        address: (host, port) to serve viewers on, or None.
        save: File to write, or None.
        memory_limit: Data kept for later viewers, e.g. "512MiB"; the oldest is dropped first.

    Raises:
        Unavailable: Another program took the port meanwhile.
    """

    def __init__(self, address: tuple[str, int] | None, save: Path | None, memory_limit: str = "512MiB") -> None:
        sinks: list[Any] = []
        if address is not None:
            sinks.append(rr.GrpcServerSink(*address, server_memory_limit=memory_limit))
        if save is not None:
            sinks.append(rr.FileSink(str(save)))
        batching = rr.ChunkBatcherConfig(flush_tick=FLUSH_EVERY_S)
        self._stream = rr.RecordingStream(APPLICATION, batcher_config=batching)
        if sinks:
            self._stream.set_sinks(*sinks)
        if address is not None:
            try:
                self._stream.flush(timeout_sec=LISTENS_S)  # fails where Rerun could not listen
            except RuntimeError as error:
                where = "{}:{}".format(*address)
                raise Unavailable(f"the recording cannot be served at {where} ({error}); is the port taken?") from error

    def fixed(self, path: Sequence[str], *content: Any) -> None:
        """Log static data."""
        self._stream.log(list(path), *content, static=True)

    def at(self, times: Mapping[str, int], path: Sequence[str], *content: Any) -> None:
        """Log at a moment of the timelines "trial" and "epoch"."""
        self._stream.reset_time()
        for name, value in times.items():
            self._stream.set_time(name, sequence=value)
        self._stream.log(list(path), *content)

    def columns(self, path: Sequence[str], times: Iterable[rr.TimeColumn], content: Iterable[Any]) -> None:
        """Log many moments at once."""
        self._stream.send_columns(rr.new_entity_path(list(path)), indexes=times, columns=content)

    def layout(self, blueprint: rrb.Blueprint) -> None:
        """Arrange the panels, once and before anything else: a second time would undo what users changed."""
        self._stream.send_blueprint(blueprint, make_active=True, make_default=True)
        self._flush(LAYOUT_S)  # otherwise data may overtake it inside Rerun

    def close(self, within_s: float) -> bool:
        """Write out what is buffered and end the file; returns whether that was done in time."""

        def finish() -> None:
            self._flush(within_s)
            self._stream.disconnect()

        thread = threading.Thread(target=finish, name="crkr-recording", daemon=True)
        thread.start()
        thread.join(timeout=within_s)
        return not thread.is_alive()

    def _flush(self, within_s: float) -> None:
        try:
            self._stream.flush(timeout_sec=within_s)
        except (RuntimeError, ValueError) as error:  # a viewer did not read in time; a file is complete at the end
            _logger.warning("not all of the recording may have reached every viewer yet: %s", error)


@final
class NameLimit:
    """The names of one kind that are drawn: the first ones, at most `each` for an owner and `total` in all.

    Args:
        kind: What they name, e.g. "paths".
        each: The most of one owner.
        total: The most of all owners.
        say: Called the first time that a name is not drawn.
    """

    def __init__(self, kind: str, each: int, total: int, say: Callable[[str], object]) -> None:
        self._kind = kind
        self._each = each
        self._total = total
        self._say = say
        self._known: set[tuple[str, str]] = set()
        self._count: Counter[str] = Counter()
        self._said = False

    def admits(self, name: str, owner: str = "") -> bool:
        """Whether the name is drawn; a new one is drawn while there is room."""
        if (owner, name) in self._known:
            return True
        if len(self._known) < self._total and self._count[owner] < self._each:
            self._known.add((owner, name))
            self._count[owner] += 1
            return True
        if not self._said:
            self._said = True
            whose = f" of {owner}" if owner else ""
            self._say(f"more {self._kind}{whose} than are shown: at most {self._each} each and {self._total} in all")
        return False
