"""The server's endpoint and Zenoh's configuration: explicit endpoints, no discovery, no shared memory."""

from __future__ import annotations

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, final

import zenoh

from crkr.client.network.diagnosis import EXAMPLE, fault_in
from crkr.protocol import Invalid
from crkr.protocol.zenoh_files import named_files

__all__ = ["DEFAULT_ENDPOINT", "Connection"]

DEFAULT_ENDPOINT: Final = EXAMPLE
_VARIABLE: Final = "CRKR_CONNECT"
_LEASE_MS: Final = 2000  # a broken link is noticed after this; Zenoh's default is 10 s
_HANDSHAKE_MS: Final = 1000
_ZENOH_LEASE_MS: Final = 10_000
# Discovery would find other people's servers; shared memory leaks segments when processes are killed.
_FIXED: Final[dict[str, Any]] = {
    "mode": "client",
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
}


@final
@dataclass(frozen=True, slots=True)
class Connection:
    """How to reach a server.

    Attributes:
        endpoint: Zenoh endpoint, e.g. "tcp/127.0.0.1:7447" or "tls/learner:7447"; several, with commas between them,
            where another server takes over when one dies.
        zenoh_config: Zenoh configuration (JSON5) with certificates or passwords; the settings above override it.
    """

    endpoint: str
    zenoh_config: Path | None = None

    @classmethod
    def choose(cls, endpoint: str | None, zenoh_config: Path | None) -> Connection:
        """The endpoints given, else $CRKR_CONNECT, else the file's, else the default.

        Raises:
            Invalid: An endpoint is not of the form protocol/host:port, or the file cannot be read.
        """
        variable = os.environ.get(_VARIABLE) or None
        chosen, named = endpoint or variable, "the endpoint"
        if chosen == variable:  # also where a command read the variable
            named = f"the endpoint in {_VARIABLE}"
        if chosen is None and zenoh_config is not None:
            chosen, named = _listed_endpoints(_load(zenoh_config)), f"the endpoint in {zenoh_config}"
        chosen = chosen or DEFAULT_ENDPOINT
        connection = cls(chosen, zenoh_config)
        for one in connection.endpoints:
            if fault := fault_in(one):
                raise Invalid(f"{named} is {one!r:.200}: {fault}; one looks like {DEFAULT_ENDPOINT!r}")
        connection.zenoh(1.0)
        return connection

    @property
    def endpoints(self) -> list[str]:
        """Each endpoint."""
        return [one.strip() for one in self.endpoint.split(",")]

    def zenoh(self, patience_s: float, turn: int = 0) -> zenoh.Config:
        """Zenoh's configuration for one attempt to connect.

        Args:
            patience_s: How long it takes at most [s].
            turn: Which of several endpoints comes first: Zenoh opens a session at the first only, and tries all in
                turn once a connection was lost.

        Raises:
            Invalid: Zenoh refuses a setting.
        """
        config = _load(self.zenoh_config)
        patience_ms = max(1, int(1000 * patience_s))
        settings = {
            **_FIXED,
            "connect/endpoints": self.endpoints[turn:] + self.endpoints[:turn],
            "connect/timeout_ms": patience_ms,
            "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
            "transport/unicast/open_timeout": _HANDSHAKE_MS,  # also of each reconnection later, whatever is left now
        }
        if json.loads(config.get_json("transport/link/tx/lease")) == _ZENOH_LEASE_MS:
            settings["transport/link/tx/lease"] = _LEASE_MS
        try:
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise Invalid(f"Zenoh refuses endpoint {self.endpoint!r}: {brief(error)}") from error
        return config


def _load(path: Path | None) -> zenoh.Config:
    if path is None:
        return zenoh.Config()
    try:
        config = zenoh.Config.from_file(path)
        for name, file in named_files(path, config.get_json).items():
            config.insert_json5(name, json.dumps(file))
        return config
    except zenoh.ZError as error:
        raise Invalid(f"Zenoh configuration {path} cannot be read: {brief(error)}") from error


def _listed_endpoints(config: zenoh.Config) -> str | None:
    endpoints = json.loads(config.get_json("connect/endpoints"))
    if isinstance(endpoints, dict):  # one list for each mode
        endpoints = endpoints.get("client", [])
    return ",".join(one for one in endpoints if isinstance(one, str)) or None


def brief(error: BaseException) -> str:
    """Zenoh's message without source file names."""
    return re.sub(r"\s+at /\S+|\s*\.?\s*$", "", str(error).split("\n")[0])
