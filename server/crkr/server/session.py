"""The server's own Zenoh session, which is the router that clients connect to."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import zenoh

from crkr.protocol import MAX_MESSAGE_BYTES, CrkrError, Invalid, Unavailable
from crkr.protocol.keys import live_peer_key
from crkr.protocol.zenoh_files import named_files, refusing_panics

__all__ = ["DEFAULT_LISTEN", "endpoints", "open_private_session", "open_session", "reachable_servers"]

DEFAULT_LISTEN: Final = "tcp/127.0.0.1:7447"

# Required: clients find the session by address only, and it answers from the moment it is open.
_ALWAYS: Final[dict[str, Any]] = {
    "mode": "router",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "scouting/delay": 0,
    "transport/shared_memory/enabled": False,
}
# Defaults, where a configuration file keeps Zenoh's own. A silent partition is noticed after one lease [ms].
_DEFAULTS: Final[dict[str, Any]] = {
    "transport/link/tx/lease": 2000,
    # A client that does not read its answers blocks the answering thread, and so others, this long [us], and is then
    # cut off. It reconnects once it reads again.
    "transport/link/tx/queue/congestion_control/block/wait_before_close": 500_000,
    # Connections that never speak the protocol must not keep others from connecting [ms, count].
    "transport/unicast/accept_timeout": 2000,
    "transport/unicast/accept_pending": 1000,
    # An incomplete message is kept as long as its connection, one for each of seven priorities. Up to twice the
    # protocol's largest message with its key is received and refused as too large; the rest is dropped [bytes, count].
    "transport/link/rx/max_message_size": 2 * MAX_MESSAGE_BYTES + 2**18,
    "transport/unicast/max_sessions": 512,
    "listen/endpoints": [DEFAULT_LISTEN],  # Zenoh's router would listen on every interface
}

_REACH_S: Final = 1.0  # for finding other servers
# A peer may not run yet, or be away for a while: Zenoh keeps trying while the session is open.
_PEERS: Final[dict[str, Any]] = {
    "connect/timeout_ms": 0,
    "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
}
_SOURCE_PLACE: Final = re.compile(r" at \S+\.rs:\d+\.?\]?")


def open_session(
    listen: str | None, config_file: Path | None, peers: Sequence[str] = (), zenoh_id: str | None = None
) -> zenoh.Session:
    """Open the router session.

    Args:
        listen: Endpoint, e.g. "tcp/127.0.0.1:7447"; None: the file's, or that one.
        config_file: Zenoh configuration (JSON5), for TLS, access control and the like.
        peers: Endpoints of other servers, whose routers are linked to this one.
        zenoh_id: The session's id, in hexadecimal digits; None: a random one.

    Raises:
        Invalid: The file or the endpoint is not understood.
        Unavailable: The endpoint cannot be listened on, e.g. the port is taken.
    """
    more: dict[str, Any] = {**_PEERS, "connect/endpoints": list(peers)} if peers else {}
    config = _config(listen, config_file, more if zenoh_id is None else {**more, "id": zenoh_id})
    try:
        with refusing_panics():
            return zenoh.open(config)
    except zenoh.ZError as error:
        where = ", ".join(_endpoints(config))
        reason = _reason(error)
        if "Address already in use" in reason:
            reason = "the port is in use; stop what listens there or choose another"
        raise Unavailable(f"cannot listen on {where}: {reason}") from error


def open_private_session() -> zenoh.Session:
    """Open a router session that listens nowhere and connects to nobody."""
    with refusing_panics():
        return zenoh.open(_config(None, None, {"listen/endpoints": []}))


def reachable_servers(peers: Sequence[str], config_file: Path | None) -> set[str]:
    """Zenoh ids of the servers that share their tasks, by the first peer that answers."""
    for peer in peers:
        told = {"mode": "client", "connect/endpoints": [peer], "connect/timeout_ms": int(1000 * _REACH_S)}
        config = _config(None, config_file, {**told, "listen/endpoints": []})
        with suppress(zenoh.ZError), refusing_panics(), zenoh.open(config) as session:
            found = session.liveliness().get(live_peer_key("*"), timeout=_REACH_S)
            return {str(reply.ok.key_expr).rpartition("/")[2] for reply in found if reply.ok is not None}
    return set()


def endpoints(listen: str | None, config_file: Path | None) -> list[str]:
    """The endpoint at which `open_session` would listen; raises `Invalid` as it does."""
    return _endpoints(_config(listen, config_file))


def _endpoints(config: zenoh.Config) -> list[str]:
    listed = json.loads(config.get_json("listen/endpoints"))
    return list(listed.get("router", []) if isinstance(listed, dict) else listed)  # a map has a list for each mode


def _config(
    listen: str | None, config_file: Path | None, more: Mapping[str, Any] = MappingProxyType({})
) -> zenoh.Config:
    usual = zenoh.Config()
    try:
        config = zenoh.Config() if config_file is None else zenoh.Config.from_file(str(config_file))
        given = {name: value for name, value in _DEFAULTS.items() if config.get_json(name) == usual.get_json(name)}
        if config_file is not None:
            given |= named_files(config_file, config.get_json)
        if listen is not None:
            given["listen/endpoints"] = [listen]
        for name, value in {**_ALWAYS, **given, **more}.items():
            config.insert_json5(name, json.dumps(value))
    except zenoh.ZError as error:
        named = ", ".join(repr(one) for one in (listen, *more.get("connect/endpoints", ())) if one is not None)
        what = f"Zenoh configuration {config_file}" if config_file else f"endpoint {named}"
        raise _refusal(what, error) from error
    return config


def _refusal(what: str, error: zenoh.ZError) -> CrkrError:
    return Invalid(f"{what} is not understood: {_reason(error)}")


def _reason(error: zenoh.ZError) -> str:
    """The error's own words, without the places in Zenoh's sources."""
    return _SOURCE_PLACE.sub("", str(error)).strip()
