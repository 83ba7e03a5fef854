"""A connection to one server: information about it, its tasks, and new tasks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypedDict, final
from uuid import UUID

from crkr.client.checks import answer_to, plain
from crkr.client.lifetimes import Closing
from crkr.client.network.config import Connection
from crkr.client.network.role import Role
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.rpc import Rpc
from crkr.client.task import Task
from crkr.client.transport import Transport
from crkr.protocol import Invalid, TaskSpec, check_name, rpc_key
from crkr.protocol.checks import flag, integer, required, text
from crkr.protocol.earlier_python import NotRequired

__all__ = ["Client", "TaskSummary"]


class TaskSummary(TypedDict):
    """One entry of `Client.tasks`."""

    spec: TaskSpec
    samples: int
    active: int
    model_version: int
    archived: bool
    fault: NotRequired[str]  # why it stopped learning, or could not be restored


@final
class Client(Closing):
    """A client of a policy server, for a robot, a simulator or a notebook.

    The first call connects, so the server may start later than the client, and each call tries until its deadline.
    Threads may share a client; processes may not: make a new one after a fork.

    Attributes:
        endpoint: Zenoh endpoint of the server.
    """

    def __init__(
        self,
        endpoint: str | None = None,
        *,
        timeout_s: float = 5.0,
        zenoh_config: Path | str | None = None,
        transport: Transport | None = None,
    ) -> None:
        """Checks where the server is; the first call connects.

        Args:
            endpoint: Zenoh endpoint; $CRKR_CONNECT or "tcp/127.0.0.1:7447" where absent.
            timeout_s: Deadline of calls that name none [s].
            zenoh_config: Zenoh configuration file (JSON5), for certificates and passwords.
            transport: Another way to the server, instead of Zenoh to an endpoint; closed with the client.

        Raises:
            Invalid: The endpoint, the time or the file is not valid, or there are both an endpoint and a transport.
        """
        if transport is None:
            connection = Connection.choose(endpoint, None if zenoh_config is None else Path(zenoh_config))
            transport = ZenohTransport(connection)
        elif endpoint is not None or zenoh_config is not None:
            raise Invalid("give an endpoint and its configuration, or a transport, not both")
        self.endpoint: Final = transport.endpoint
        self._rpc: Final = Rpc(transport, timeout_s)

    def info(self, *, timeout_s: float | None = None) -> dict[str, Any]:
        """About the server: `protocol`, `version`, `server_id`, `started` [unix s], `tasks`, `task_count`, `faulty`...

        `tasks` has the names of the first 1000 tasks; `Client.tasks` returns all. `faulty` has the tasks that cannot be
        served, with the reason.

        Raises:
            Unavailable: No answer in time.
        """
        reply = self._rpc.call(rpc_key("info"), {}, timeout_s)
        with answer_to("info"):
            return {key: plain(value) for key, value in reply.items()}

    def server_id(self, *, timeout_s: float | None = None) -> UUID:
        """Which server answers: the id of its data directory, without the rest of `info`."""
        return self._rpc.server_id(timeout_s)

    def wait_until_ready(self, patience_s: float) -> dict[str, Any]:
        """Waits for the server and returns its `info`; raises `Unavailable` after `patience_s`."""
        return self.info(timeout_s=patience_s)

    def tasks(self, *, timeout_s: float | None = None) -> list[TaskSummary]:
        """Every task: `spec` (in force), `samples`, `active`, `model_version`, `archived`; `fault` if there is one.

        Args:
            timeout_s: Deadline of all pages together [s].

        Raises:
            Unavailable: Part of the list did not come by the deadline; `iter_tasks` has a deadline for each page.
        """
        pages = self._rpc.task_pages(self._rpc.deadline(timeout_s))
        return [summary for page in pages for summary in _summaries(page)]

    def iter_tasks(self) -> Iterator[TaskSummary]:
        """Every task as in `tasks`, page by page; each page has the client's deadline."""
        after: int | None = 0
        while after is not None:
            page, after = self.task_page(after)
            yield from page

    def task_page(self, after: int = 0, *, timeout_s: float | None = None) -> tuple[list[TaskSummary], int | None]:
        """One page of `tasks`: the tasks past the first `after`, and the next `after` (None at the end)."""
        page, following = self._rpc.task_page(after, timeout_s)
        return _summaries(page), following

    def create_task(self, spec: TaskSpec | Mapping[str, Any], *, timeout_s: float | None = None) -> Task:
        """Creates a task; where it exists with the same specification, description aside, returns that.

        Args:
            spec: A specification, or its fields as plain data.
            timeout_s: Deadline [s].

        Raises:
            Invalid: The specification is not valid.
            Conflict: The name exists with another specification; `details["fields"]` has name -> [stored, given].
        """
        checked = spec if isinstance(spec, TaskSpec) else TaskSpec.from_dict(spec)
        reply = self._rpc.call(rpc_key("create_task"), checked.to_dict(), timeout_s)
        return Task(self._rpc, checked.name, created=reply.get("created") is True)

    def task(self, name: str) -> Task:
        """A task by name; asks the server nothing, so the first call may raise `UnknownTask`.

        Raises:
            Invalid: The name cannot be a task's.
        """
        return Task(self._rpc, check_name(name))

    def take_role(self, task: str, role: str, *, timeout_s: float | None = None) -> Role | None:
        """Takes a role that one process at a time has in a task; None where another process has it.

        Raises:
            Invalid: The name cannot be a task's or a role's.
            Unavailable: No connection in time.
        """
        return self._rpc.transport.take_role(check_name(task), role, self._rpc.deadline(timeout_s))

    def close(self) -> None:
        """Ends the connection; calls in progress end with `Unavailable`."""
        self._rpc.transport.close()


def _summaries(page: Iterable[Mapping[str, Any]]) -> list[TaskSummary]:
    with answer_to("tasks"):
        return [_summary(entry) for entry in page]


def _summary(entry: Mapping[str, Any]) -> TaskSummary:
    summary: TaskSummary = {
        "spec": TaskSpec.from_dict(required(entry, "spec")),
        "samples": integer(required(entry, "samples"), "samples"),
        "active": integer(required(entry, "active"), "active"),
        "model_version": integer(required(entry, "model_version"), "model_version"),
        "archived": flag(entry.get("archived", False), "archived"),
    }
    if "fault" in entry:
        summary["fault"] = text(entry["fault"], "fault")
    return summary
