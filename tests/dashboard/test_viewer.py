import os
import select
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from crkr.dashboard.rerun_view import Recording
from crkr.dashboard.viewer import Viewer, choose_port, page_address, require_display, stream_address
from crkr.protocol import Invalid, Unavailable

HOST = "127.0.0.1"
LOOPBACK = "0100007F"  # as /proc/net/tcp writes it
LISTENING = "0A"


def listeners(port: int) -> set[str]:
    """Addresses that somebody listens on at a port, of both families."""
    rows = [
        line.split() for table in ("tcp", "tcp6") for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[3] == LISTENING and int(row[1].split(":")[1], 16) == port}


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()


def test_the_page_answers_on_loopback_only_and_is_gone_afterwards(free_port: int) -> None:
    with Viewer.web(HOST, HOST, free_port, stream_address(HOST, 1)) as viewer:
        with urllib.request.urlopen(f"http://{HOST}:{free_port}/", timeout=60) as answer:
            assert answer.status == 200
            assert b"<canvas" in answer.read()
        assert listeners(free_port) == {LOOPBACK}
        assert is_alive(viewer.pid)
    assert not is_alive(viewer.pid)
    assert listeners(free_port) == set()


def test_the_viewer_leaves_no_statistics_settings_in_the_users_home(
    free_port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("XDG_CONFIG_HOME", raising=False)
    with Viewer.web(HOST, HOST, free_port, stream_address(HOST, 1)):
        assert list(tmp_path.rglob("analytics.json")) == []


def test_a_viewer_whose_port_is_taken_says_so(free_port: int) -> None:
    with (
        Viewer.web(HOST, HOST, free_port, stream_address(HOST, 1)),
        pytest.raises(Unavailable, match="the viewer ended at once"),
    ):
        Viewer.web(HOST, HOST, free_port, stream_address(HOST, 1))


def test_no_viewer_outlives_a_process_that_was_killed(free_port: int) -> None:
    program = (
        "import sys\n"
        "from crkr.dashboard.viewer import Viewer\n"
        f"viewer = Viewer.web('{HOST}', '{HOST}', {free_port}, 'rerun+http://{HOST}:1/proxy')\n"
        "print(viewer.pid, flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        descriptor = os.pidfd_open(child)
        try:
            parent.send_signal(signal.SIGKILL)
            # A pidfd becomes readable when its process ends.
            assert select.select([descriptor], [], [], 10.0)[0] == [descriptor]
        finally:
            os.close(descriptor)


def test_a_window_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(Invalid, match="needs a display"):
        require_display()


def test_the_pages_address_names_the_stream() -> None:
    parts = urlsplit(page_address(HOST, 9090, 9876))
    assert parts.netloc == f"{HOST}:9090"
    assert parse_qs(parts.query)["url"] == [f"rerun+http://{HOST}:9876/proxy"]


@pytest.fixture
def taken() -> Iterator[int]:
    with socket.create_server((HOST, 0)) as listener:
        port: int = listener.getsockname()[1]
        yield port


@pytest.fixture
def claims() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_a_free_port_is_taken_as_it_is(free_port: int, claims: ExitStack) -> None:
    assert choose_port(HOST, free_port, 1, claims) == free_port
    assert choose_port(HOST, None, free_port, claims) == free_port


def test_the_next_free_port_stands_in_for_a_taken_default(taken: int, claims: ExitStack) -> None:
    chosen = choose_port(HOST, None, taken, claims)
    assert chosen > taken
    with socket.create_server((HOST, chosen)):
        pass


def test_who_chooses_before_the_other_listens_gets_another_port(free_port: int, claims: ExitStack) -> None:
    with ExitStack() as others:
        chosen = {choose_port(HOST, None, free_port, stack) for stack in (claims, others, claims)}
        assert len(chosen) == 3
    with ExitStack() as later:
        assert choose_port(HOST, None, free_port, later) in chosen


def test_a_taken_port_that_was_asked_for_is_refused(taken: int, claims: ExitStack) -> None:
    with pytest.raises(Invalid, match=f"port {taken} on {HOST} is taken"):
        choose_port(HOST, taken, 1, claims)


def test_a_recording_whose_port_was_taken_meanwhile_says_so(taken: int) -> None:
    with pytest.raises(Unavailable, match=f"cannot be served at {HOST}:{taken}"):
        Recording((HOST, taken), None)
