"""Why a TLS connection fails: Zenoh says "Timeout" whatever the reason is.

A plain handshake with the same certificates shows the reason, by this side's check of the server's certificate or by
the server's alert.
"""

from __future__ import annotations

import json
import re
import socket
import ssl
import time
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Final, final

import zenoh

from crkr.client.call_threads import CallThreads
from crkr.protocol.earlier_python import UTC

__all__ = ["certificate_end", "connection_to", "refusal"]

_ADDRESS: Final = re.compile(r"(tls|tcp)/\[?([^\]?#]+?)\]?:(\d+)(?:[?#].*)?")
_ALERT_S: Final = 0.1  # beyond the way, for a server that is busy
_CLOCK: Final = "or the clock of one of the two machines is wrong"


@final
@dataclass(frozen=True, slots=True)
class _Identity:
    """What a configuration says about certificates."""

    authority: Path | None
    certificate: Path | None
    key: Path | None
    shows_one: bool
    checks_name: bool

    @classmethod
    def of(cls, config: zenoh.Config) -> _Identity:
        tls: dict[str, Any] = json.loads(config.get_json("transport/link/tls"))

        def file(name: str) -> Path | None:
            return Path(tls[name]) if tls.get(name) else None

        shown = tls.get("enable_mtls") is True  # Zenoh shows none otherwise
        return cls(
            file("root_ca_certificate"),
            file("connect_certificate") if shown else None,
            file("connect_private_key") if shown else None,
            shows_one=shown,
            checks_name=tls.get("verify_name_on_connect") is not False,
        )


def refusal(endpoint: str, config: zenoh.Config, patience_s: float) -> str | None:
    """Tries the handshake alone and says why it fails; None where it succeeds, or no program listens.

    Args:
        endpoint: Zenoh endpoint; only tls and tcp can be checked.
        config: Zenoh's configuration, with the certificates.
        patience_s: Longest time [s]; a server that is silent for that long has refused nothing.
    """
    parts = _ADDRESS.fullmatch(endpoint)
    if parts is None:
        return None
    protocol, host, port = parts.groups()
    deadline = time.monotonic() + patience_s
    identity = _Identity.of(config) if protocol == "tls" else _Identity(None, None, None, False, False)
    if identity.shows_one and identity.certificate is None:  # inside the configuration, which does not show it
        return None
    try:
        context = _context(identity)
    except (OSError, ValueError) as error:
        return f"the certificate {identity.certificate} or its key cannot be used: {_words(error)}"
    try:
        with connection_to(host, int(port), deadline) as connection:
            _shake_hands(connection, context, host, deadline)
    except ssl.SSLError as error:
        return _reason(error, identity, host) if protocol == "tls" else _unexpected_tls(error)
    except (OSError, UnicodeError):  # no program listens or answers, or the host is not a name
        return None
    return None if protocol == "tls" else _unexpected_tls(None)


def certificate_end(endpoint: str, config: zenoh.Config, patience_s: float) -> datetime | None:
    """When the server's certificate expires; None where there is none, or it cannot be checked."""
    parts = _ADDRESS.fullmatch(endpoint)
    if parts is None or parts[1] != "tls":
        return None
    try:
        context = _context(_Identity.of(config))
        with (
            connection_to(parts[2], int(parts[3]), time.monotonic() + patience_s) as connection,
            context.wrap_socket(connection, server_hostname=parts[2]) as secured,
        ):
            found: Any = secured.getpeercert()
    except (OSError, ValueError):
        return None
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(found["notAfter"]), UTC) if found else None


def _context(identity: _Identity) -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = identity.checks_name and identity.authority is not None
    if identity.authority is None:  # public authorities, or one inside the configuration: Zenoh checks it
        context.verify_mode = ssl.CERT_NONE
    else:
        context.load_verify_locations(identity.authority)
    if identity.certificate is not None:
        context.load_cert_chain(identity.certificate, identity.key)
    return context


def connection_to(host: str, port: int, deadline: float, kind: socket.SocketKind = socket.SOCK_STREAM) -> socket.socket:
    """Connects by the deadline; the name look-up has none of its own, so it runs on a thread.

    Raises:
        OSError: No connection; `socket.gaierror` where the host has no address.
    """
    threads = CallThreads("crkr-names")
    looked_up = threads.submit(partial(socket.getaddrinfo, host, port, type=kind))
    threads.close()
    try:
        addresses = looked_up.result(max(0.001, deadline - time.monotonic()))
    except (TimeoutError, FutureTimeoutError) as error:  # one and the same from Python 3.11 on
        raise socket.gaierror(socket.EAI_AGAIN, "the name server does not answer") from error
    failure = OSError(f"{host} has no address")
    for family, *_, address in addresses:
        if kind == socket.SOCK_DGRAM:
            return socket.socket(family, kind)
        try:
            return socket.create_connection((str(address[0]), port), timeout=max(0.001, deadline - time.monotonic()))
        except OSError as error:
            failure = error
    raise failure


def _shake_hands(connection: socket.socket, context: ssl.SSLContext, host: str, deadline: float) -> None:
    began = time.monotonic()
    connection.settimeout(max(0.001, deadline - began))
    with context.wrap_socket(connection, server_hostname=host) as secured:
        # In TLS 1.3 the server checks the client's certificate after the client is done: one more round trip.
        now = time.monotonic()
        secured.settimeout(max(0.001, min(deadline - now, _ALERT_S + 2 * (now - began))))
        with suppress(TimeoutError):
            secured.recv(1)


def _reason(error: ssl.SSLError, identity: _Identity, host: str) -> str | None:
    if isinstance(error, ssl.SSLCertVerificationError):
        return _certificate_fault(error, identity, host)
    alert, mine = error.reason or "", identity.certificate
    if "CERTIFICATE_REQUIRED" in alert or (mine is None and "HANDSHAKE_FAILURE" in alert):
        return "the server admits only clients with a certificate, and this one shows none: name it in --zenoh-config"
    if "CERTIFICATE_EXPIRED" in alert:
        return f"the server does not accept the certificate {mine}: it has expired, {_CLOCK}"
    if any(word in alert for word in ("UNKNOWN_CA", "DECRYPT_ERROR", "CERTIFICATE", "ACCESS_DENIED")):
        return f"the server does not accept the certificate {mine}: it is of another authority than the server's"
    if "ALERT" in alert:
        return f"the server broke off the TLS handshake: {_words(error)}"
    if alert == "WRONG_VERSION_NUMBER":
        return "what listens there does not speak TLS"
    return None  # the connection just ended, as with a server that stops


def _certificate_fault(error: ssl.SSLCertVerificationError, identity: _Identity, host: str) -> str:
    match error.verify_code:  # OpenSSL's X509_V_ERR_...: not yet valid, expired, another name, another address
        case 9:
            return f"the server's certificate is not valid yet, {_CLOCK}"
        case 10:
            return f"the server's certificate has expired, {_CLOCK}"
        case 62 | 64:
            return f"the server's certificate is not for {host!r}: connect by a name it was made for, or make a new one"
    return f"the server's certificate is not of the authority {identity.authority}: {error.verify_message}"


def _unexpected_tls(error: ssl.SSLError | None) -> str | None:
    """For an endpoint without TLS: says that TLS runs there, as a handshake or an alert shows."""
    if error is None or "ALERT" in (error.reason or ""):
        return "what listens there speaks TLS: connect to tls/..., with certificates by --zenoh-config"
    return None


def _words(error: Exception) -> str:
    reason = getattr(error, "reason", None) or getattr(error, "strerror", None)
    return str(reason or error).lower().replace("_", " ")
