"""Zenoh connections that are cut, carry one way only, or are changed on the way to what no binding would send."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, final

Change = Callable[[bytes], bytes | None]
_KEEP_ALIVE = b"\x04"  # the batch that says only that its sender is alive
_SEGMENT, _SLOW_BUFFER = 1448, 65536  # bytes
_HANDSHAKE = 2  # batches that a router sends before a connection is open


def _batches(source: socket.socket) -> Iterator[bytes]:
    """Zenoh writes each batch behind its length, two bytes."""
    kept = b""
    while data := source.recv(1 << 20):
        kept += data
        place = 0
        while len(kept) - place >= 2:
            (length,) = struct.unpack_from("<H", kept, place)
            if len(kept) - place < 2 + length:
                break
            yield kept[place + 2 : place + 2 + length]
            place += 2 + length
        kept = kept[place:]


def _upwards(source: socket.socket, server: socket.socket, change: Change) -> None:
    with suppress(OSError):
        for batch in _batches(source):
            changed = change(batch)
            if changed is not None:
                server.sendall(struct.pack("<H", len(changed)) + changed)
    with suppress(OSError):
        server.shutdown(socket.SHUT_RDWR)


def _downwards(server: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while data := server.recv(65536):
            target.sendall(data)
    with suppress(OSError):
        target.shutdown(socket.SHUT_RDWR)


@contextmanager
def changed_on_the_way(server_port: int, change: Change) -> Iterator[str]:
    """An endpoint before a server; `change` is given each batch and returns what is sent in its place, or None."""
    with ExitStack() as stack, socket.create_server(("127.0.0.1", 0)) as listener:

        def accept() -> None:
            with suppress(OSError):
                while True:
                    client, _ = listener.accept()
                    stack.callback(client.close)
                    server = socket.create_connection(("127.0.0.1", server_port))
                    stack.callback(server.close)
                    threading.Thread(target=_upwards, args=(client, server, change), daemon=True).start()
                    threading.Thread(target=_downwards, args=(server, client), daemon=True).start()

        accepting = threading.Thread(target=accept, daemon=True)
        accepting.start()
        try:
            yield f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            accepting.join()


@final
class Cable:
    """TCP from a port of its own to another; while it is cut, all stays where it is and nobody is told.

    All connections share `bytes_per_s` on the way up.
    """

    def __init__(self, port: int, bytes_per_s: float = float("inf")) -> None:
        self._port, self._bytes_per_s = port, bytes_per_s
        self._turn, self._time = threading.Lock(), threading.Event()
        self._whole = threading.Event()
        self._whole.set()
        self._ends: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._count = 0
        self._silent: set[int] = set()  # connections, by their order
        self._listener = socket.create_server(("127.0.0.1", 0))
        if bytes_per_s != float("inf"):  # or the system would hold seconds of what is to be carried slowly
            self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SLOW_BUFFER)
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._run(self._accept)

    @contextmanager
    def cut(self) -> Iterator[None]:
        self._whole.clear()
        yield
        self._whole.set()

    def silence(self, coming: int = 0) -> None:
        """From now on the present connections, and the next ones, bring nothing back but signs of life."""
        self._silent.update(range(self._count + coming))

    def break_off(self, *, silencing: int = 0) -> None:
        """Ends each connection; of the next that come, `silencing` bring nothing back but signs of life."""
        self._silent.update(range(self._count, self._count + silencing))
        self._end(self._ends)

    def close(self) -> None:
        self._whole.set()
        self._end([self._listener, *self._ends])
        for thread in self._threads:
            thread.join(10)

    @staticmethod
    def _end(sockets: list[socket.socket]) -> None:
        for end in sockets:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _run(self, work: Callable[..., None], *arguments: Any) -> None:
        self._threads.append(threading.Thread(target=work, args=arguments))
        self._threads[-1].start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._port))
                self._ends += [near, far]
                self._run(self._carry, near, far)
                self._run(self._bring, far, near, self._count)
                self._count += 1

    def _carry(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(_SEGMENT):
                self._whole.wait()
                with self._turn:
                    self._time.wait(len(data) / self._bytes_per_s)
                sink.sendall(data)
        with suppress(OSError):
            self._whole.wait()
            sink.shutdown(socket.SHUT_WR)

    def _bring(self, source: socket.socket, sink: socket.socket, number: int) -> None:
        with suppress(OSError):
            for count, batch in enumerate(_batches(source)):
                self._whole.wait()
                carried = _KEEP_ALIVE if number in self._silent and count >= _HANDSHAKE else batch
                sink.sendall(struct.pack("<H", len(carried)) + carried)
        with suppress(OSError):
            self._whole.wait()
            sink.shutdown(socket.SHUT_WR)
