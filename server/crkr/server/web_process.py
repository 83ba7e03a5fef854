"""The live pages of `crkr server --web`, served by a separate process that is a client like any other.

If it fails, the server continues. The socket is the server's, so that a taken port is reported at once, and readers
wait while the process restarts.
"""

from __future__ import annotations

import errno
import importlib.util
import ipaddress
import logging
import socket
import subprocess
import sys
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Final, final

from crkr.protocol import Invalid, Unavailable
from crkr.server.thread_faults import keep_running

__all__ = ["WebProcess"]

logger = logging.getLogger(__name__)

_QUEUED: Final = 512  # waiting readers
_PAUSE_S: Final = 2.0  # before a restart
_ENDS_S: Final = 1.0


@final
class WebProcess:
    """Listens from the beginning, and serves from `start` on.

    Attributes:
        address: Host and port that it listens on.

    Raises:
        Unavailable: The address cannot be listened on, e.g. the port is taken.
        ModuleNotFoundError: The extra 'web' is not installed.
    """

    def __init__(self, host: str, port: int) -> None:
        for package in ("uvicorn", "starlette"):
            if importlib.util.find_spec(package) is None:
                raise ModuleNotFoundError(f"No module named {package!r}", name=package)
        self._socket = _listening(host, port)
        number = self._socket.getsockname()[1]
        self.address: Final = f"[{host}]:{number}" if ":" in host else f"{host}:{number}"
        self._stop, self._starting = threading.Event(), threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._thread: threading.Thread | None = None

    def start(self, endpoint: str, zenoh_config: Path | None) -> None:
        """Start the process, and restart it whenever it ends; a second call does nothing.

        Args:
            endpoint: Where the server listens.
            zenoh_config: A client's Zenoh configuration, where the server asks for certificates or passwords.
        """
        if self._thread is not None:
            return
        command = [sys.executable, "-m", "crkr.client", "page", "--serve", self.address]
        command += ["--socket-fd", str(self._socket.fileno()), "--connect", _reachable(endpoint)]
        command += [] if zenoh_config is None else ["--zenoh-config", str(zenoh_config)]
        step = partial(self._serve, command)
        self._thread = threading.Thread(target=keep_running, args=(step,), name="web process", daemon=True)
        self._thread.start()

    def _serve(self, command: list[str]) -> bool:
        with self._starting:
            if self._stop.is_set():
                return False
            # It ends with its pipe, so a killed server leaves no process behind.
            process = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[self._socket.fileno()])
            self._process = process
        with process:
            status = process.wait()
        if self._stop.wait(_PAUSE_S):
            return False
        logger.warning("the process of the web page ended with status %d; it is started again", status)
        return True

    def close(self) -> None:
        """End the process and stop listening."""
        self._stop.set()
        with self._starting:
            process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(_ENDS_S)
            except subprocess.TimeoutExpired:
                process.kill()
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(_ENDS_S)
        self._socket.close()


def _listening(host: str, port: int) -> socket.socket:
    made = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, port))
        made.listen(_QUEUED)
    except OSError as error:
        made.close()
        taken = "the port is in use; stop what listens there or choose another"
        reason = taken if error.errno == errno.EADDRINUSE else error.strerror or str(error)
        raise Unavailable(f"cannot serve the web page on {host}:{port}: {reason}") from error
    return made


def _reachable(endpoint: str) -> str:
    """The endpoint for a client on this machine.

    Raises:
        Invalid: The port is 0, so that the process cannot know the real one.
    """
    scheme, _, place = endpoint.partition("/")
    host, _, port = place.partition("?")[0].partition("#")[0].rpartition(":")
    if port == "0":
        raise Invalid(f"the web page needs a server at a fixed port; got {endpoint}")
    with suppress(ValueError):  # a name
        address = ipaddress.ip_address(host.strip("[]"))
        if address.is_unspecified:  # it listens on every interface
            host = "127.0.0.1" if address.version == 4 else "[::1]"
    return f"{scheme}/{host}:{port}"
