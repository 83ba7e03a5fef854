"""A time limit for calls of a skill, which cannot be interrupted: a thread reports an endless call."""

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
    """Contexts in which `GuardedSkill` calls a skill's methods, in this thread.

    Args:
        limit_s: Time limit of a call [s].
        late: Called once from another thread if a call takes longer, with the method's name and its current line. It
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
    """A thread's current line in the skill's file; "" if unknown."""
    own = next((later.filename for before, later in pairwise(frames) if before.filename == guarded_skill.__file__), "")
    lines = [frame.lineno for frame in frames if frame.filename == own]
    return f"{Path(own).name}, line {lines[-1]}" if lines else ""
