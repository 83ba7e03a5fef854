"""Rerun's viewer as a child process, its web page or its window, and the ports for them."""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from contextlib import ExitStack
from pathlib import Path
from typing import Final, final
from urllib.parse import quote

from crkr.client.lifetimes import Closing
from crkr.protocol import Invalid, Unavailable

__all__ = ["Viewer", "choose_port", "page_address", "require_display", "stream_address"]

_logger = logging.getLogger(__name__)
SERVING: Final = "Hosting a web-viewer at"
READY_S: Final = 20.0
ENDS_S: Final = 1.0
TRIED: Final = 100  # ports

# Linux ends the child when this process is killed: no viewer is left behind.
_TIED: Final = (
    "import ctypes, os, sys\n"
    "if sys.platform == 'linux': ctypes.CDLL(None).prctl(1, 15)\n"
    "os.getppid() == int(sys.argv[1]) and os.execv(sys.argv[2], sys.argv[2:])\n"
)


def stream_address(host: str, port: int) -> str:
    """Address of the recording, for a viewer."""
    return f"rerun+http://{host}:{port}/proxy"


def page_address(host: str, web_port: int, port: int) -> str:
    """Address of the viewer's page, for a browser."""
    stream = quote(stream_address(host, port), safe="")
    return f"http://{host}:{web_port}/?url={stream}&theme=dark&hide_welcome_screen=1&persist=0"


def choose_port(host: str, given: int | None, default: int, claims: ExitStack) -> int:
    """A port that can be listened on, and that no other process of crkr chooses meanwhile.

    Args:
        host: Address to listen on.
        given: The port that was asked for, or None.
        default: The first port to try where none was asked for.
        claims: Ends the claim to the port.

    Raises:
        Invalid: The given port is taken, or a hundred in a row are.
    """
    if given is not None:
        if not _is_free(host, given):
            raise Invalid(f"port {given} on {host} is taken; choose another, or none and a free one is found")
        return given
    for port in range(default, default + TRIED):
        if _is_claimed(host, port, claims) and _is_free(host, port):
            return port
    raise Invalid(f"no free port from {default} to {default + TRIED - 1} on {host}")


def _is_claimed(host: str, port: int, claims: ExitStack) -> bool:
    """Claim a TCP port, of which Rerun makes use a while later, by holding the UDP port of that number."""
    claim = claims.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    try:
        claim.bind((host, port))
    except OSError:
        return False
    return True


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        # As servers do: a connection of an earlier run may linger on the port.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def require_display() -> None:
    """Raise `Invalid` where no window can be opened."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise Invalid("--native needs a display, and there is none here; use --web or --terminal")


@final
class Viewer(Closing):
    """Rerun's viewer as a child process; a context manager that ends it.

    Its usage statistics are off; the page that it serves has its own setting, in the browser.
    """

    def __init__(self, arguments: list[str]) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="crkr-viewer-")
        self._log = Path(self._home.name) / "viewer.log"
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _TIED, str(os.getpid()), _binary(), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=_environment(Path(self._home.name)),
                start_new_session=True,  # Ctrl-C ends the command first, and the child when the recording is complete
            )

    @classmethod
    def web(cls, bind: str, host: str, web_port: int, stream: str) -> Viewer:
        """Serve the viewer's page; returns when it answers.

        Args:
            bind: Address to serve it on.
            host: The same address as a browser on this machine sees it.
            web_port: Port to serve it on.
            stream: Address of the recording.

        Raises:
            Unavailable: The page does not answer.
        """
        viewer = cls(["--serve-web", "--bind", bind, "--web-viewer-port", str(web_port), stream])
        try:
            viewer._wait_for(f"http://{host}:{web_port}/")
        except BaseException:
            viewer.close()
            raise
        return viewer

    @classmethod
    def native(cls, stream: str, own_port: int) -> Viewer:
        """Open the viewer's window; it listens on `own_port` in any case."""
        return cls(["--bind", "127.0.0.1", "--port", str(own_port), "--connect", stream])

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def last_line(self) -> str:
        """The last line of its log."""
        lines = self._log.read_text(errors="replace", encoding="utf-8").strip().splitlines()
        return lines[-1] if lines else "no output"

    def close(self) -> None:
        """End the viewer."""
        if self.is_running:
            self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(ENDS_S)
            except subprocess.TimeoutExpired:
                _logger.warning("the viewer (process %d) does not end; killed", self.pid)
                self._process.kill()
                self._process.wait(ENDS_S)
        self._home.cleanup()

    def _wait_for(self, address: str) -> None:
        """Wait until the viewer logs that it serves, and answers, as another program may answer on a taken port."""
        deadline = time.monotonic() + READY_S
        while time.monotonic() < deadline:
            if not self.is_running:
                raise Unavailable(f"the viewer ended at once: {self.last_line()}")
            if SERVING in self._log.read_text(errors="replace", encoding="utf-8") and _answers(address):
                return
            try:
                self._process.wait(0.05)
            except subprocess.TimeoutExpired:
                continue
        raise Unavailable(f"the viewer's page at {address} did not answer within {READY_S:.0f} s: {self.last_line()}")


_fetch: Final = urllib.request.build_opener(urllib.request.ProxyHandler({})).open  # never by a proxy


def _answers(address: str) -> bool:
    try:
        with _fetch(address, timeout=1.0):
            return True
    except (urllib.error.URLError, OSError):
        return False


def _binary() -> str:
    """Path of the viewer, not of the `rerun` script, which could end without it.

    Raises:
        ModuleNotFoundError: Rerun is not installed.
    """
    package = importlib.util.find_spec("rerun_cli")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'rerun'", name="rerun")
    return str(Path(package.origin).with_name("rerun.exe" if sys.platform == "win32" else "rerun"))


def _environment(home: Path) -> dict[str, str]:
    """The child's environment, with temporary settings and usage statistics off."""
    settings = home / "rerun" / "analytics.json"
    settings.parent.mkdir()
    settings.write_text(
        json.dumps(
            {
                "analytics_enabled": False,
                "analytics_id": "none",
                "metadata": {},
                "config_file_path": str(settings),
                "data_dir_path": str(home / "data"),
            }
        ),
        encoding="utf-8",
    )
    return {**os.environ, "XDG_CONFIG_HOME": str(home), "NO_COLOR": "1"}
