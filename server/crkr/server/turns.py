"""What waits to be answered, by task: the tasks take turns, so that one that asks much does not hold up the others."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Final, final

from crkr.server.request import Request

__all__ = ["Turns"]

_MOST_OF_A_TASK: Final = 1024
_MOST: Final = 8192


@final
class Turns:
    """Waiting requests, each task's in the order they came. For one thread."""

    def __init__(self) -> None:
        self._by_task: OrderedDict[str, deque[Request]] = OrderedDict()  # none is empty; whose turn is next comes first
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, request: Request) -> bool:
        """Takes a request in; False: too many wait already."""
        queue = self._by_task.get(request.task)
        if self._count >= _MOST or (queue is not None and len(queue) >= _MOST_OF_A_TASK):
            return False
        if queue is None:
            queue = self._by_task[request.task] = deque()
        queue.append(request)
        self._count += 1
        return True

    def take(self, most: int) -> list[Request]:
        """At most so many, one of each task in turn."""
        batch: list[Request] = []
        while self._by_task and len(batch) < most:
            task, queue = next(iter(self._by_task.items()))
            batch.append(queue.popleft())
            if queue:
                self._by_task.move_to_end(task)
            else:
                del self._by_task[task]
        self._count -= len(batch)
        return batch

    def put_back(self, requests: Sequence[Request]) -> None:
        """The last of those taken, in the same order: they are next."""
        for request in reversed(requests):
            self._by_task.setdefault(request.task, deque()).appendleft(request)
            self._by_task.move_to_end(request.task, last=False)
        self._count += len(requests)
