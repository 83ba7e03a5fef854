"""`crkr doctor`: what works, what does not, and what to do about it."""

from __future__ import annotations

import os
import platform
import shutil
import statistics
import tempfile
import time
from datetime import datetime
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Annotated, Any

import typer

from crkr.client import Client
from crkr.client.cli.console import print_json, print_table
from crkr.client.cli.options import Connect, Json, Timeout, ZenohConfig
from crkr.client.commands.status import ended_threads, named_tasks, thread_faults
from crkr.client.network.config import Connection
from crkr.client.network.diagnosis import ANYBODY, NO_SERVER, access_rights, impostors, obstacle
from crkr.client.network.tls_handshake import certificate_end
from crkr.client.network.zenoh_transport import ZenohTransport
from crkr.client.outbox.outbox_file import OutboxFile
from crkr.protocol import PROTOCOL_VERSION, CrkrError, Invalid, Unavailable
from crkr.protocol.earlier_python import UTC

__all__ = ["doctor"]

_ROUND_TRIPS = 50
_LITTLE_BYTES = 1 << 30
_HANDSHAKE_S = 2.0
_RENEW_DAYS = 14
_Check = tuple[str, bool, str]


def doctor(
    connect: Connect = None,
    timeout: Timeout = 5.0,
    zenoh_config: ZenohConfig = None,
    data: Annotated[
        str | None,
        typer.Option("--data", metavar="DIR|URL", help="Also check the disk of a data directory, or a database."),
    ] = None,
    outbox: Annotated[
        Path | None, typer.Option("--outbox", metavar="FILE", help="Also check an outbox that no program has open.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Check versions, connection, protocol, round trip and disk; exits 1 if something is wrong.

    Example: crkr doctor --connect tcp/127.0.0.1:7447 --data data
    """
    checks = [_versions(), *_server(connect, timeout, zenoh_config)]
    if data is not None:
        checks += _database(data) if data.startswith(("postgresql://", "postgres://")) else _disk(Path(data))
    if outbox is not None:
        checks.append(_outbox(outbox))
    fine = all(passed for _, passed, _ in checks)
    if as_json:
        print_json({"ok": fine, "checks": [{"check": c, "ok": ok, "detail": text} for c, ok, text in checks]})
    else:
        print_table(("check", "", "detail"), [(c, "ok" if ok else "FAILED", text) for c, ok, text in checks])
    if not fine:
        raise typer.Exit(1)


def _versions() -> _Check:
    packages = {"crkr": "crkr", "zenoh": "eclipse-zenoh", "numpy": "numpy", "msgpack": "msgpack"}
    listed = ", ".join(f"{name} {version(package)}" for name, package in packages.items())
    return "versions", True, f"{listed}, Python {platform.python_version()}"


def _server(connect: str | None, timeout_s: float, zenoh_config: Path | None) -> list[_Check]:
    try:
        transport = ZenohTransport(Connection.choose(connect, zenoh_config))
        with Client(transport=transport, timeout_s=timeout_s) as client:
            return [("endpoint", True, client.endpoint), *_conversation(client, transport)]
    except Invalid as error:
        return [("endpoint", False, error.message)]


def _conversation(client: Client, transport: ZenohTransport) -> list[_Check]:
    connection = transport.session.connection
    try:
        info = client.info()
        trips = [_seconds(client.server_id) for _ in range(_ROUND_TRIPS)]
    except CrkrError as error:
        return [("reachable", False, _trouble(error, connection))]
    return [
        ("reachable", True, f"server {info.get('version')}, id {info.get('server_id')}"),
        *_certificate(connection),
        *_answers(info, trips),
        *_access(transport, info),
        *_impostors(transport, info),
    ]


def _trouble(error: CrkrError, connection: Connection) -> str:
    """Everything known about why the server does not answer; other commands refer to this one."""
    tried = error.details
    if not isinstance(error, Unavailable) or "reason" not in tried:
        return error.message
    where, advice = f"no answer from {tried['endpoint']} in {tried['tried_s']:.1f} s ({tried['reason']})", ""
    if tried["reason"] == ANYBODY:
        advice = "; does the server's access control know this client, or is the server overloaded?"
    elif tried["reason"] == NO_SERVER:
        return f"no crkr server at {tried['endpoint']}: {tried['reason']}; connect to where `crkr server --listen` is"
    elif tried["reason"].startswith("connected"):
        advice = "; is the server overloaded or stopped?"
    elif found := obstacle(connection.endpoint, connection.zenoh(_HANDSHAKE_S), _HANDSHAKE_S):
        return f"no connection to {connection.endpoint}: {found.what}"
    elif _certificate(connection):
        advice = "; the certificates are in order there: are user and password?"
    elif connection.endpoint.startswith("tls/"):
        advice = "; is a server with TLS running there, and of the authority that --zenoh-config names?"
    else:
        advice = "; what listens there takes connections and says nothing: is the server stopped, is a password wrong?"
    return where + advice


def _certificate(connection: Connection) -> list[_Check]:
    end = certificate_end(connection.endpoints[0], connection.zenoh(_HANDSHAKE_S), _HANDSHAKE_S)
    if end is None:
        return []
    left = (end - datetime.now(UTC)).days
    advice = "" if left >= _RENEW_DAYS else f": {left} days are left, make new ones and restart the server"
    return [("certificate", not advice, f"the server's is valid until {end:%Y-%m-%d}{advice}")]


def _impostors(transport: ZenohTransport, info: dict[str, Any]) -> list[_Check]:
    """Other clients that answer in the server's place; their answers are ignored."""
    session = transport.session.peek()
    if info.get("protocol") != PROTOCOL_VERSION or session is None or not session.info.routers_zid():
        return []
    found = impostors(session, [*info.get("tasks", []), "none"][0])
    if not found:
        return []
    who = ", ".join(sorted(found))
    return [
        ("trust", False, f"another client answers too and is ignored (Zenoh id {who}): access control can forbid it")
    ]


def _access(transport: ZenohTransport, info: dict[str, Any]) -> list[_Check]:
    session = transport.session.peek()
    if info.get("protocol") != PROTOCOL_VERSION or session is None:
        return []
    answers = access_rights(session, [*info.get("tasks", []), "none"][0])

    def those(outcome: bool | None) -> str:
        return ", ".join(work for work, answered in answers.items() if answered is outcome)

    told = f"may {', '.join(filter(None, ['look', those(True)]))}"
    told += f"; the server's configuration denies: {those(False)}" if those(False) else ""
    return [("access", True, told + (f"; not answered in time: {those(None)}" if those(None) else ""))]


def _answers(info: dict[str, Any], trips: list[float]) -> list[_Check]:
    spoken = info.get("protocol")
    same = spoken == PROTOCOL_VERSION
    advice = "" if same else f"; this client speaks {PROTOCOL_VERSION}: install the same version of crkr on both sides"
    median, worst = 1000 * statistics.median(trips), 1000 * max(trips)
    return [
        ("protocol", same, f"version {spoken}{advice}"),
        ("round trip", True, f"median {median:.2f} ms, worst of {len(trips)} {worst:.2f} ms"),
        ("tasks", True, named_tasks(info)),
        *(("task", False, f"{name}: {fault}") for name, fault in (info.get("faulty") or {}).items()),
        _threads(info),
    ]


def _threads(info: dict[str, Any]) -> _Check:
    ended, faults = ended_threads(info), thread_faults(info)
    if ended:
        return "threads", False, f"ended: {', '.join(ended)}; restart the server, its log says why"
    return "threads", True, f"all run; faults they survived: {faults}; see the server's log" if faults else "all run"


def _seconds(call: Any) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _outbox(path: Path) -> _Check:
    try:
        file = OutboxFile.existing(path)
    except CrkrError as error:
        return "outbox", False, error.message
    try:
        pending, refused = file.pending(), file.refused()
    except CrkrError as error:
        return "outbox", False, error.message
    finally:
        file.close()
    told = f"{pending} trials of task {file.task!r} wait"
    if refused:
        told += f", {len(refused)} were put aside, the first for {refused[0].error}; see Outbox.refused and discard"
    return "outbox", not refused, told


def _database(url: str) -> list[_Check]:
    """What the server's part finds, by entry point, as the client knows no database."""
    found = list(entry_points(group="crkr.data_checks", name="database"))
    if not found:
        return [("database", False, "nothing that is installed reads databases: pip install 'crkr[postgres]'")]
    try:
        return [("database", True, found[0].load()(url))]
    except CrkrError as error:
        return [("database", False, error.message)]


def _disk(directory: Path) -> list[_Check]:
    try:
        free = shutil.disk_usage(directory).free
        with tempfile.TemporaryFile(dir=directory) as file:
            trips = []
            for _ in range(20):
                file.write(b"\0" * 4096)
                file.flush()
                trips.append(_seconds(lambda: os.fsync(file.fileno())))
    except OSError as error:
        return [("disk", False, f"{directory} cannot be written: {error.strerror}")]
    enough = free > _LITTLE_BYTES
    advice = "" if enough else "; make room, a full disk refuses reports"
    return [
        ("disk", enough, f"{free / 1e9:.1f} GB free{advice}"),
        ("commit", True, f"a durable write takes {1000 * statistics.median(trips):.2f} ms"),
    ]
