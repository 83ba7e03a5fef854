"""Names that others made up, kept from filling a display: at most so many of a kind for each owner, and in all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import final

__all__ = ["Names"]


@final
class Names:
    """The first names of one kind; the others have no place.

    Args:
        kind: What they name, for people, e.g. "paths".
        each: How many an owner may have.
        total: How many all may have.
        say: Told the first time that one has no place.
    """

    def __init__(self, kind: str, each: int, total: int, say: Callable[[str], object]) -> None:
        self._kind = kind
        self._each = each
        self._total = total
        self._say = say
        self._known: set[tuple[str, str]] = set()
        self._count: Counter[str] = Counter()
        self._said = False

    def has_place(self, name: str, owner: str = "") -> bool:
        """Whether the name is one of them; a new one is as long as there is room."""
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
