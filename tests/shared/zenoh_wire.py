"""A Zenoh connection whose batches can be changed on their way to the server: what no binding would send."""

import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress

Change = Callable[[bytes], bytes | None]


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
