"""Silent or slow connections to the metrics neither block a scraper nor cost the server."""

import os
import socket
import threading
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack, closing
from typing import Any

from processes import Processes

from crkr.server.metrics.endpoint import MetricsEndpoint

MOST = 16


def scrape(address: str) -> str:
    with urllib.request.urlopen(f"http://{address}/metrics", timeout=10) as answer:
        page: str = answer.read().decode()
    return page


def threads(pid: int) -> int:
    return len(os.listdir(f"/proc/{pid}/task"))


def test_connections_that_are_held_keep_no_scraper_out_and_are_bounded(
    start_server: Callable[..., Any], free_port: int, processes: Processes
) -> None:
    server, address = start_server("--metrics", str(free_port)), f"127.0.0.1:{free_port}"
    before = threads(server.process.pid)
    with ExitStack() as stack:
        held = []
        for number in range(5 * MOST):
            held.append(stack.enter_context(socket.create_connection(("127.0.0.1", free_port), timeout=10)))
            held[-1].sendall(b"GET /metrics HTT" if number % 2 else b"")
        assert "process_resident_memory_bytes" in scrape(address)
        for connection in held[: 4 * MOST]:
            assert connection.recv(100) == b""  # the oldest made room
        processes.wait_until(lambda: threads(server.process.pid) <= before + MOST)
        assert held[-1].send(b"P/1.0\r\n\r\n") == 9
        assert held[-1].recv(15) == b"HTTP/1.0 200 OK"  # the newest did not need to
    processes.wait_until(lambda: threads(server.process.pid) <= before)
    assert "Traceback" not in server.log.read_text()


def test_one_that_says_nothing_is_cut_off(processes: Processes) -> None:
    before = threading.active_count()
    with closing(MetricsEndpoint("127.0.0.1", 0, patience_s=0.1)) as endpoint:
        host, _, port = endpoint.address.rpartition(":")
        with socket.create_connection((host, int(port)), timeout=10) as silent:
            assert silent.recv(1) == b""
        assert "process_resident_memory_bytes" in scrape(endpoint.address)
        processes.wait_until(lambda: threading.active_count() == before + 1)
