"""A time limit for calls of a skill: they cannot be interrupted, so a thread reports one that does not end."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Final

from crkr.sim_worker import guarded_skill

__all__ = ["time_limit"]

LOOKS_S: Final = 0.25  # between two looks at the clock, or a quarter of a shorter limit


@contextmanager
def time_limit(
    limit_s: float, late: Callable[[str, str], None]
) -> Iterator[Callable[[str], AbstractContextManager[None]]]:
    """Gives the blocks that `GuardedSkill` calls a skill's methods within, in this thread.

    Args:
        limit_s: How long a call may take [s].
        late: Is told once, from another thread, of a call that takes longer: the method's name, and where it is. It
            must end the process, as nothing else ends such a call.
    """
    caller, over, running = threading.get_ident(), threading.Event(), list[tuple[str, float]]()

    def watch() -> None:
        while not over.wait(min(LOOKS_S, limit_s / 4)):
            for method, began in running[:1]:
                if time.monotonic() - began > limit_s:
                    late(method, _place(traceback.extract_stack(sys._current_frames()[caller])))
                    return

    @contextmanager
    def within(method: str) -> Iterator[None]:
        running.append((method, time.monotonic()))
        try:
            yield
        finally:
            running.clear()

    threading.Thread(target=watch, name="time limit", daemon=True).start()
    try:
        yield within
    finally:
        over.set()


def _place(frames: Sequence[traceback.FrameSummary]) -> str:
    """The line of the skill's own file that a thread has come to, "" if that is unknown."""
    own = next((later.filename for before, later in pairwise(frames) if before.filename == guarded_skill.__file__), "")
    lines = [frame.lineno for frame in frames if frame.filename == own]
    return f"{Path(own).name}, line {lines[-1]}" if lines else ""
