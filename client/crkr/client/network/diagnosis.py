"""Why no server answers at an endpoint, and what access control allows: Zenoh says "Timeout" or nothing.

finding                                      found by
the endpoint is not valid                    its text: protocol, host, port
its host has no address                      a name look-up
nobody listens, or the host does not answer  a TCP connection
TLS on one side only, or a certificate       a handshake, see `crkr.client.network.tls_handshake`
another program listens                      its first words
a Zenoh router without a crkr server         no server's token
"""

from __future__ import annotations

import errno
import re
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, final

import zenoh

from crkr.client.network.tls_handshake import connection_to, refusal
from crkr.client.network.trust import EVERYONE, NotTheServer, Trust
from crkr.protocol import encoding, live_server_key, pack, rpc_key, task_key
from crkr.protocol.keys import admin_key

__all__ = [
    "ANYBODY",
    "EXAMPLE",
    "NO_SERVER",
    "Obstacle",
    "access_rights",
    "fault_in",
    "impostors",
    "is_deaf",
    "obstacle",
    "silence_of",
]

EXAMPLE: Final = "tcp/127.0.0.1:7447"
_WITH_PORT: Final = ("tcp", "udp", "tls", "quic", "quic_datagram", "ws")
_OTHERS: Final = ("serial", "unixpipe", "unixsock-stream", "vsock")
_TALK: Final = b"GET / HTTP/1.0\r\n\r\n"  # to Zenoh the beginning of a long message, to a web server a question
_TALK_S: Final = 0.2
_TOKENS_S: Final = 0.5
_ANSWER_S: Final = 2.0
ANYBODY: Final = "connected, but nobody serves this key, or the server's access control denies it to this client"
NO_SERVER: Final = (
    "connected, but to a Zenoh router where no crkr server shows: another router, as ROS 2's rmw_zenohd, which listens "
    "on port 7447 too, or a server whose access control denies this client everything"
)


@final
@dataclass(frozen=True, slots=True)
class Obstacle:
    """An obstacle to a connection.

    Attributes:
        what: In words, with advice.
        final: Another attempt cannot help, as with certificates that do not match.
        absent: No program listens there.
    """

    what: str
    final: bool = False
    absent: bool = False


def fault_in(endpoint: str) -> str | None:
    """What is wrong with the text of an endpoint, or None."""
    protocol, slash, address = endpoint.partition("/")
    if not slash or not address or re.search(r"\s", endpoint) or not re.fullmatch(r"[a-z0-9_-]+", protocol):
        return "it is not of the form protocol/address"
    if protocol not in _WITH_PORT + _OTHERS:
        return f"the protocol {protocol!r} is unknown; Zenoh speaks {', '.join(_WITH_PORT + _OTHERS)}"
    if protocol in _OTHERS:
        return None
    host, colon, port = re.split(r"[?#]", address, maxsplit=1)[0].rpartition(":")
    if not colon or (host.startswith("[") and not host.endswith("]")):
        return f"the port is missing: {protocol}/{address.rstrip(':')}:7447"
    if not host:
        return "the host is missing before the port"
    if not re.fullmatch(r"[0-9]+", port):
        return f"the port is missing or no number: {port!r}" if port else "the port is missing after the colon"
    if not 1 <= int(port) <= 65535:
        return f"{port} is not a port: ports are 1 to 65535"
    return None


def obstacle(endpoint: str, config: zenoh.Config, patience_s: float) -> Obstacle | None:
    """Finds what keeps a client from connecting, or None.

    Args:
        endpoint: An endpoint without a `fault_in` it, or several with commas between them, where one has to be free.
        config: Zenoh's, with the certificates.
        patience_s: Longest time for this [s].
    """
    found = []
    several = endpoint.split(",")
    for one in several:
        if (way := _obstacle(one.strip(), config, patience_s / len(several))) is None:
            return None
        found.append(way)
    what = "; ".join(one.what for one in found)
    return Obstacle(what, all(one.final for one in found), all(one.absent for one in found))


def _obstacle(endpoint: str, config: zenoh.Config, patience_s: float) -> Obstacle | None:
    deadline = time.monotonic() + patience_s
    protocol, address = endpoint.split("/", 1)
    if protocol not in _WITH_PORT:
        return None
    host, _, port = re.split(r"[?#]", address, maxsplit=1)[0].rpartition(":")
    host = host.strip("[]")
    try:
        if protocol in ("udp", "quic", "quic_datagram"):  # there is no connection to test
            connection_to(host, int(port), deadline, socket.SOCK_DGRAM).close()
            return None
        connection_to(host, int(port), deadline).close()
    except (socket.gaierror, UnicodeError):
        return Obstacle(f"the host {host!r} has no address: is its name right, and is there a name server?")
    except ConnectionRefusedError:
        what = f"nobody listens at {host}:{port}: is a server running there? start one: crkr server"
        return Obstacle(what, absent=True)
    except TimeoutError:
        return Obstacle(f"the host {host} does not answer: is it on, or does a firewall shut port {port}?")
    except OSError as error:
        if error.errno in (errno.ENETUNREACH, errno.EHOSTUNREACH):
            return Obstacle(f"the host {host} cannot be reached: {error.strerror}")
        return None
    if found := refusal(endpoint, config, deadline - time.monotonic()):
        return Obstacle(found, final=protocol == "tls")
    if protocol == "tcp" and (said := _first_words(host, int(port), deadline)):
        return Obstacle(f"what listens at {host}:{port} is {said} and does not speak Zenoh: is the port right?")
    return None


def silence_of(session: zenoh.Session, patience_s: float) -> str:
    """Why a question is neither answered nor refused on a working connection; takes at most `patience_s`."""
    patience_s = min(_TOKENS_S, patience_s)
    with suppress(zenoh.ZError):
        tokens = session.liveliness().get(live_server_key("*"), zenoh.handlers.FifoChannel(4), timeout=patience_s)
        for reply in tokens:
            return ANYBODY if reply.ok is not None else "connected, but no reply in time"
        return NO_SERVER
    return ANYBODY


def is_deaf(session: zenoh.Session, patience_s: float) -> bool:
    """Whether the router that Zenoh is connected to does not answer in that time, not even that no server shows."""
    replies = session.liveliness().get(live_server_key("*"), zenoh.handlers.FifoChannel(4), timeout=patience_s)
    return any(reply.ok is None for reply in replies) and bool(session.info.routers_zid())


def _first_words(host: str, port: int, deadline: float) -> str | None:
    """What kind of program speaks first; None for one that waits, as Zenoh does."""
    said = b""
    with suppress(OSError), connection_to(host, port, deadline) as connection:
        connection.settimeout(max(0.001, min(_TALK_S, deadline - time.monotonic())))
        connection.sendall(_TALK)
        said = connection.recv(16)
    if said.startswith(b"HTTP/"):
        return "a web server"
    if said.startswith(b"SSH-"):
        return "an SSH server"
    return "something else" if said else None


def access_rights(session: zenoh.Session, task: str) -> dict[str, bool | None]:
    """Whether access control allows each kind of call; None: no answer in time.

    Sends empty messages, which the server refuses as `Invalid` without storing anything: any answer means yes.
    """
    keys = {
        "predict": task_key(task, "predict"),
        "report": task_key(task, "report"),
        "create tasks": rpc_key("create_task"),
        "administer": admin_key(task, "recost"),
    }
    return {work: _is_answered(session, key) for work, key in keys.items()}


def impostors(session: zenoh.Session, task: str) -> set[str]:
    """Zenoh ids of other clients that answer questions to the server; waits for all answers.

    Empty behind another router, where the server cannot be told from other clients.
    """
    trust, others, known = Trust(), dict[str, zenoh.Reply](), False
    for key in (rpc_key("info"), task_key(task, "predict"), task_key(task, "report")):
        for reply in _ask(session, key):
            if trust.is_server(session, reply):
                known = True
            elif reply.replier_id is not None:
                others[str(reply.replier_id.zid)] = reply
    trust.sharing_server(session, others)
    return {zid for zid, reply in others.items() if not trust.is_server(session, reply)} if known else set()


def _ask(session: zenoh.Session, key: str) -> zenoh.handlers.Handler[zenoh.Reply]:
    return session.get(
        key,
        zenoh.handlers.FifoChannel(4),
        payload=pack({}),
        encoding=encoding(key.rpartition("/")[2]),
        consolidation=zenoh.ConsolidationMode.NONE,
        target=EVERYONE,
        timeout=_ANSWER_S,
    )


def _is_answered(session: zenoh.Session, key: str) -> bool | None:
    replies = _ask(session, key)
    try:
        reply = Trust().pick(session, replies, {})
    except (zenoh.ZError, NotTheServer):
        return False
    late = reply.err is not None and reply.err.payload.to_bytes() == b"Timeout"  # Zenoh's own
    return None if late else True
