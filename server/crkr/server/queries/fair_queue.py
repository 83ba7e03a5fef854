"""Queues in which tasks and clients take turns, so that a busy one does not delay the others."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Sequence
from typing import Final, Generic, TypeVar, final

from crkr.server.queries.request import Job, Request

__all__ = ["FairQueue", "RoundRobin"]

_MOST_OF_A_TASK: Final = 1024
_MOST: Final = 8192
_Job = TypeVar("_Job", bound=Job)


@final
class RoundRobin:
    """Waiting requests by task, in order of arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._by_task: OrderedDict[str, deque[Request]] = OrderedDict()  # none is empty; the next task comes first
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, request: Request) -> bool:
        """Add a request; False if too many wait already."""
        queue = self._by_task.get(request.task)
        if self._count >= _MOST or (queue is not None and len(queue) >= _MOST_OF_A_TASK):
            return False
        if queue is None:
            queue = self._by_task[request.task] = deque()
        queue.append(request)
        self._count += 1
        return True

    def take(self, most: int) -> list[Request]:
        """Take at most `most` requests, one of each task in turn."""
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
        """Put back the last requests taken, in the same order; they are next."""
        for request in reversed(requests):
            self._by_task.setdefault(request.task, deque()).appendleft(request)
            self._by_task.move_to_end(request.task, last=False)
        self._count += len(requests)


@final
class _Line(Generic[_Job]):
    """The jobs of one client for one task."""

    __slots__ = ("jobs", "oldest")

    def __init__(self) -> None:
        self.jobs: list[_Job] = []
        self.oldest = False  # whether the oldest job was taken last time, rather than the shortest


@final
class FairQueue(Generic[_Job]):
    """Jobs that wait in a lane. Tasks take turns, and the clients within a task. Not thread-safe.

    Of one client's jobs for one task, the oldest and the shortest are taken alternately, so that a small question does
    not wait for a huge one that is answered in slices. A queue that keeps order always takes the oldest.
    """

    def __init__(self, keeps_order: bool = False) -> None:
        self._keeps_order = keeps_order
        # Task -> client -> its jobs; the next one comes first.
        self._by_task: OrderedDict[str, OrderedDict[bytes, _Line[_Job]]] = OrderedDict()
        self._count = 0
        self._place = 0  # of the last job taken, among its client's jobs

    def __len__(self) -> int:
        return self._count

    def wait(self, task: str) -> int:
        """Number of turns that a new job of a task would wait."""
        own = sum(len(line.jobs) for line in self._by_task.get(task, {}).values())
        return own * len(self._by_task)

    def append(self, job: _Job) -> None:
        """Add a job behind those of its task and client."""
        self._jobs(job).append(job)
        self._count += 1

    def popleft(self) -> _Job:
        """Take the next job."""
        task, clients = next(iter(self._by_task.items()))
        client, line = next(iter(clients.items()))
        jobs, line.oldest = line.jobs, self._keeps_order or not line.oldest
        self._place = 0 if line.oldest else min(range(len(jobs)), key=lambda place: jobs[place].left)
        job = jobs.pop(self._place)
        self._count -= 1
        clients.move_to_end(client)
        self._by_task.move_to_end(task)
        if not jobs:
            del clients[client]
        if not clients:
            del self._by_task[task]
        return job

    def put_back(self, job: _Job) -> None:
        """Put the last job taken back in its place among its client's jobs; others take their turns first."""
        self._jobs(job).insert(self._place, job)
        self._count += 1

    def clear(self) -> list[_Job]:
        """Take all jobs."""
        left = [job for clients in self._by_task.values() for line in clients.values() for job in line.jobs]
        self._by_task.clear()
        self._count = 0
        return left

    def _jobs(self, job: _Job) -> list[_Job]:
        clients = self._by_task.setdefault(job.task, OrderedDict())
        if job.client not in clients:
            clients[job.client] = _Line()
        return clients[job.client].jobs
